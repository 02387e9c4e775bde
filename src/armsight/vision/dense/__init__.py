"""Dense stereo: a pair in standard form goes in, a disparity for every pixel comes out; the contract is in method.py."""

"""Following a body of discs from shot to shot: shots go in, poses with covariance come out, faster than by a full search.

``follower.py``: the motion model, when to search the whole image, the records. ``kernel.py``: the one compiled call
that measures a pair of images around a predicted pose.
"""

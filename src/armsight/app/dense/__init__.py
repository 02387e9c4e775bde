"""``armsight dense``: a disparity, and with a rig a depth, for every pixel; and the evaluation of the methods.

In: a pair of images or a source, with a rig or already rectified; for the evaluation, scenes in the layouts of the
Middlebury benchmark. Out: disparity, depth, sigma and state as images, a point cloud; tables of errors and error maps.
"""

"""``armsight dense``: a disparity, and with a rig a depth, for every pixel; and the evaluation of the methods.

In: a pair of images or a source, with a rig or already rectified; for the evaluation, scenes in the layouts of the
Middlebury benchmark. Out: disparity, depth, sigma and state as images, a point cloud; tables of errors and error maps.

- ``command``: the command line, ``armsight dense`` and ``armsight dense evaluate``.
- ``run``: one pair from images to files.
- ``files``: the files of a result, and its pictures.
- ``evaluate``: a method's errors on scenes with a known disparity.
"""

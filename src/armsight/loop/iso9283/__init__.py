"""Performance metrics of ISO 9283 (and of circles, ISO 230-4) for an arm that the cameras watch.

In: attained poses or positions, the commands, and the instrument's covariance. Out: :class:`Metric` values, each as
measured, without the instrument's noise, with its interval and with what the test could resolve.

- ``poses``: accuracy and repeatability of poses, several directions, distances, drift.
- ``paths``: accuracy and repeatability of paths; circularity, hysteresis and backlash of circles.
- ``plan``: the poses of a test within an arm's reach.
- ``statistic``: what the metrics share: errors beyond noise, and intervals.
"""

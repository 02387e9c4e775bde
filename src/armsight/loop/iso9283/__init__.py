"""Performance metrics of ISO 9283 (and of circles, ISO 230-4) for an arm that the cameras watch.

In: attained poses or positions, the commands, and the instrument's covariance. Out: :class:`Metric` values, each as
measured, without the instrument's noise, with its interval and with what the test could resolve.
"""

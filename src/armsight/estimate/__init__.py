"""Estimation: how anything is fitted and its errors weighed.

In: residuals near a state with the covariance that each source of error causes (:class:`~armsight.estimate.linear.Linear`).
Out: the unknowns with a covariance that allows for what is not known about the sources' variances.

- ``linear``: the record of residuals, derivatives and sources; sources that measurements share, by kernels.
- ``solve``: weighted least squares with shared errors as unknowns, and what it predicts of measurements left out.
- ``select``: which unknowns lower the error on measurements left out.
- ``variance``: the variances of the sources, their choice and their integration.
"""

"""``armsight demo``: the experiment of ``armsight run`` in the simulated workcell, with the truth beside it.

In: options (arm, cameras, seed). Out: a folder as that of ``armsight run``, and studies of the error. ``demo.py`` runs the
experiment; ``studies.py`` measures how the error depends on distance, baseline, resolution, noise, calibration and rate.
"""

"""``armsight calibrate``: images of a calibration target, or detections of a body, in; a rig file and a report out.

The calibration itself is in :mod:`armsight.vision.calibrate`. Here: ``assessment.py`` grades its held-out errors and gives
advice, ``run.py`` runs one calibration and prints it, ``figures.py`` plots, ``report.py`` writes the page.
"""

"""``armsight calibrate``: images of a calibration target, or detections of a body, in; a rig file and a report out."""

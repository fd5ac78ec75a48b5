"""One file a tool around the chain: made-up scenes, calibration, evaluation, reports."""

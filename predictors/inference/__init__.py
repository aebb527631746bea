"""Trained predictors: checkpoints, the predictor socket, calibration and export."""

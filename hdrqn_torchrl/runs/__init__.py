"""Runs: the training loop, evaluations, checkpoints, and the folder that they leave behind."""

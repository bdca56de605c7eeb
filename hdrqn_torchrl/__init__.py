"""Hierarchical deep recurrent Q-learning (hDRQN) on TorchRL."""

__version__ = "0.1.0"

"""The programs: ``train``, ``evaluate``, ``watch``, ``plot``, ``report``. The only part that knows Hydra."""

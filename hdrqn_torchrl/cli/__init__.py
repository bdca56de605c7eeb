"""The programs: one module each, and what they share. The only part that knows Hydra."""

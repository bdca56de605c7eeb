"""Analysis of many runs: results read back, estimates over seeds, claims, figures."""

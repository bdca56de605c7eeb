"""What many runs say together: results read back, estimates over seeds, claims, figures."""

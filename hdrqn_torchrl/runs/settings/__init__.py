"""What a run is told: settings, the builders that they may name, and what is made of them."""

"""Where steps come from: this process, captured graphs, workers here or elsewhere."""

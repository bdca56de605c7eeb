"""What a run leaves on the disk, safely: folder, checkpoints, weights."""

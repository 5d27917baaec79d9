"""Images and label maps: where their voxels lie, what they show, and the scan of a label's boundary."""

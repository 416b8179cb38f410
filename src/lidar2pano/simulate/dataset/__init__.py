"""The simulated data set: its settings, the files of a sequence, and their generation by several processes."""

"""What recipes share and that has no formula: checkpoints, command line, metrics, seeds."""

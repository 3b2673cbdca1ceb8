"""`bench lightglue`: what the network finds beside the ratio test, and what it costs."""

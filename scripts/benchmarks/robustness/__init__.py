"""Whether a verdict on a block can be believed: blocks spoilt in known ways, and good ones, by simulated tie points."""

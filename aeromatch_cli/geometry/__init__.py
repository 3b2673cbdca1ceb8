"""Mathematics of cameras, poses and planes: pure numpy float64, no configuration, no files."""

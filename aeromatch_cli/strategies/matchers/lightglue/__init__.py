"""LightGlue: the matcher, what its network is given and says, and the overlap that is shown to it."""

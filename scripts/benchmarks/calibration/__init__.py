"""How well a bundle adjustment calibrates: simulated tie points of real lenses, judged by exact truth."""

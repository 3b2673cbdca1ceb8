"""Rasters: files, depth, masks, scaling, views, and the stored picture read by parts."""

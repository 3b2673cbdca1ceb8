"""Networks: torch modules and the loading of their weights. Nothing here downloads."""

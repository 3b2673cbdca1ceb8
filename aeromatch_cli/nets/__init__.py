"""Networks: their architectures, and the loading of their weights. Nothing here downloads; torch only where it pays."""

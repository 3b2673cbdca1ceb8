"""What was flown: images, cameras, positions and attitudes, read from the formats in which people keep them."""

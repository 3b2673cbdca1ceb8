"""What a workspace holds, and what is known of it: the index of its files, and the block as the files tell it."""

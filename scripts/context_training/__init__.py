"""What train_context.py learns from."""

"""Programs that show how the pieces are used together."""

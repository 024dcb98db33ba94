"""Show how the parts are used together, as programs."""

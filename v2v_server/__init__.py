"""The server: a broker that knows no pixels, and worker processes that decode videos and simulate samples."""

"""`python -m v2v_server` is `v2v-serve`."""

from v2v_server.cli import serve

if __name__ == "__main__":
    serve()

"""The server: a broker that knows no pixels, and worker processes that decode videos and simulate samples."""

from v2v_server.system.compile_cache import use_compile_cache

# Here, because whoever imports a kernel passes here first, and numba looks where it may keep one when it meets it.
use_compile_cache()

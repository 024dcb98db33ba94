"""The server: a broker that knows no pixels, and worker processes that decode videos and simulate samples.

    serve.py      one server: owns the loop; config.py: its settings
    commands/     the command lines
    prepare/      `v2v-prepare`
    offline/      samples without a server
    console/      what the operator sees
    supervise/    who starts workers
    broker/       who gets which sample from which worker
    worker/       from a lease to its sample
    schedule/     which sequence each index is made from
    catalogue/    which videos there are
    store/        prepared clips, without loss
    flow/         optical flow
    simulation/   the virtual camera
    video/        from a file to luma
    system/       what we ask of the operating system

A room may import those below it (``tests/test_imports.py``).
"""

from v2v_server.system.compile_cache import use_compile_cache

# Here, because whoever imports a kernel passes here first, and numba looks where it may keep one when it meets it.
use_compile_cache()

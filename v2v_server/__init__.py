"""The server: a broker that handles no pixels, and worker processes that decode videos and simulate samples.

    serve.py      one server: runs the loop; config.py: its settings
    commands/     the command lines
    prepare.py    `v2v-prepare`
    status/       what the operator sees
    supervise/    start and restart workers
    broker/       which worker makes which sample for which consumer
    quarantine.py sequences that brought workers down
    worker/       from a lease to its sample
    schedule.py   which sequence each index is made from
    corpus/       which videos exist
    store/        prepared clips, lossless
    worlds/       photographs that move
    flow.py       optical flow
    simulation/   the virtual camera
    video/        from a file to luma
    system/       services of the operating system

A package may import those below it (``tests/test_imports.py``).
"""

from v2v_server.system.compile_cache import use_compile_cache

# Here, because every import of a kernel loads this package first, and numba chooses its cache when it compiles one.
use_compile_cache()

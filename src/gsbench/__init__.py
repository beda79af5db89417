"""gsbench tests whether an idea helps 3D Gaussian Splatting.

Photographs in; tables, statistics and pictures out.
"""

import os
import sys
import warnings

if (
    sys.argv[:1] == ["-m"]
    and {"gsbench", "gsbench.cli"} & set(sys.orig_argv)
    and not sys.flags.safe_path
):
    # `python -m` puts the current folder first, where a capture may hold a module of any name
    del sys.path[0]

# Loaded before pycolmap brings its own, with which Pillow's PNG writer crashes.
import zlib  # noqa: F401

# torch reads this when it is loaded: its idle threads must not spin beside those of our kernels. On
# a busy machine an optimiser step took ten times as long.
if "torch" in sys.modules and "OMP_WAIT_POLICY" not in os.environ:
    warnings.warn(
        "torch was imported first, so its idle threads spin: import gsbench before it", stacklevel=2
    )
os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
# Tensors of 2 MB or more get large pages of memory: Adam reads all of them, and waits less.
os.environ.setdefault("THP_MEM_ALLOC_ENABLE", "1")

__version__ = "0.1.0"

"""What the fork server of a system holds for all processes: the last module that it imports.

Its pages are shared with the processes that are forked from it, as long as neither writes to them. Numba with
LLVM is large, and slow to import; several services need it.
The garbage collector would write to every object that it visits, and so copy all pages: it leaves out what
exists here.
"""

from __future__ import annotations

import gc

import beamsplat.common.compiled  # noqa: F401 - imports Numba

gc.collect()
gc.freeze()

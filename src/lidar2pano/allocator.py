"""Let glibc keep large buffers for the next step instead of handing them back to the system.

By default every activation of some size is mapped, faulted in page by page and unmapped again; in a network of images
that is up to half of the CPU's time.
"""

from __future__ import annotations

import ctypes

# The names and numbers of glibc's malloc.h, with what they are set to.
M_TRIM_THRESHOLD, M_MMAP_MAX = -1, -4
SETTINGS = (
    (M_MMAP_MAX, 0),  # nothing gets a mapping of its own (the size from which it would is capped in some versions)
    (M_TRIM_THRESHOLD, -1),  # free memory at the end of the heap is never given back
)


def keep_buffers() -> bool:
    """Set glibc's allocator for the whole process; memory once used stays with it. True where that worked.

    Elsewhere (musl, macOS, Windows) nothing happens and the answer is False. Calling it again changes nothing.
    """
    try:
        libc = ctypes.CDLL(None)
        _, mallopt = libc.gnu_get_libc_version, libc.mallopt  # other C libraries lack one or both
    except (AttributeError, OSError, TypeError):
        return False
    accepted = [mallopt(setting, value) for setting, value in SETTINGS]  # all of them, whatever the first one says
    return accepted == [1, 1]

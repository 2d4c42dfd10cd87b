"""What reading a damaged file of NumPy arrays raises."""

from __future__ import annotations

import zlib
from tokenize import TokenError
from zipfile import BadZipFile

# NumPy parses the header of an array as Python.
ARRAY_DAMAGE = (
    OSError,
    ValueError,
    TypeError,
    KeyError,
    EOFError,
    MemoryError,
    BadZipFile,
    zlib.error,
    SyntaxError,
    TokenError,
)

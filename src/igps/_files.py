"""Files that appear whole or not at all."""

import contextlib
import os
import secrets
from collections.abc import Iterator
from pathlib import Path
from typing import IO

PARTIAL = ".partial"
"""The end of the name of a file that is still being written."""


@contextlib.contextmanager
def whole_file(path: Path) -> Iterator[IO[bytes]]:
    """A file to write beside its place, which is moved there in one step, whole or not at all."""
    # By an ordinary open: tempfile and safetensors make files that only their owner can read, whatever the umask.
    partial = path.with_name(f"{path.name}.{os.getpid()}-{secrets.token_hex(8)}{PARTIAL}")
    try:
        with open(partial, "xb") as file:
            yield file
        os.replace(partial, path)
    except BaseException:
        partial.unlink(missing_ok=True)
        raise

"""The store of Zarr's files on a local disk, with small files read and written at once."""

from pathlib import Path

from zarr.abc.store import ByteRequest
from zarr.core.buffer import Buffer, BufferPrototype
from zarr.storage import LocalStore

_SMALL_BYTES = 64 << 10
"""To hand a file to another thread and wait for it takes about as long as to read so much."""


class LocalFiles(LocalStore):
    """As zarr's own, which hands each file to another thread: most files here are small, a group has dozens.

    Large chunks still go to other threads, several at once.
    """

    async def get(
        self, key: str, prototype: BufferPrototype | None = None, byte_range: ByteRequest | None = None
    ) -> Buffer | None:
        """Bytes of a file, or of a part of it; None if there is none."""
        if _is_large(self.root / key):
            return await super().get(key, prototype, byte_range)
        return self.get_sync(key, prototype=prototype, byte_range=byte_range)

    async def set(self, key: str, value: Buffer) -> None:
        """Write a file whole."""
        if len(value) > _SMALL_BYTES:
            await super().set(key, value)
        else:
            self.set_sync(key, value)


def _is_large(path: Path) -> bool:
    try:
        return path.stat().st_size > _SMALL_BYTES
    except OSError:
        return False

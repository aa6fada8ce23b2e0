"""Reading and writing files; nothing here knows what the numbers mean."""

from cgemit.io.files import new_file, read_arrays, write_arrays

__all__ = ["new_file", "read_arrays", "write_arrays"]

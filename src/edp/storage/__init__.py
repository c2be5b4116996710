"""Files of EDP's own kinds: read within bounds, written whole, and locked."""

from edp.storage.locks import check_held, find_holder, hold, release
from edp.storage.reading import (
    JSON_BYTES,
    SETTINGS_BYTES,
    object_with,
    parse_json,
    parse_toml,
    read_bytes,
    read_json,
    read_object,
    read_text,
    read_toml,
)
from edp.storage.writing import (
    check_writable,
    make_folder,
    remove_unfinished,
    replacing,
    replacing_folder,
    storage_error,
    write_bytes,
    write_json,
)

__all__ = [
    "JSON_BYTES",
    "SETTINGS_BYTES",
    "check_held",
    "check_writable",
    "find_holder",
    "hold",
    "make_folder",
    "object_with",
    "parse_json",
    "parse_toml",
    "read_bytes",
    "read_json",
    "read_object",
    "read_text",
    "read_toml",
    "release",
    "remove_unfinished",
    "replacing",
    "replacing_folder",
    "storage_error",
    "write_bytes",
    "write_json",
]

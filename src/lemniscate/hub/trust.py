"""Whose code a run may import.

A run names code of its own as `module:name`, and to go on with it is to execute that code. What this user's programs
write on this machine they sign, with a key in the user's own directory; so a run from elsewhere is known as such, and
its code is imported only if the user says so.
"""

import hashlib
import hmac
import json
import os
import secrets
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from lemniscate.errors import UserError
from lemniscate.system import named

SIGNATURE = "signature"


def signed(record: Mapping[str, Any], names: Sequence[str] | None = None) -> dict[str, Any]:
    """A record with this user's signature of all its parts, or of those named; without one where no key can be kept."""
    key, parts = _key(), record if names is None else {name: record[name] for name in names}
    return {**record, SIGNATURE: _signature_of(parts, key)} if key else dict(record)


def is_signed(record: Mapping[str, Any], names: Sequence[str] = ("algorithm", "config")) -> bool:
    """Whether this user signed the parts `names` of a record, on this machine."""
    key, signature = _key(), record.get(SIGNATURE)
    unsigned = {name: record.get(name) for name in names}
    return bool(key) and isinstance(signature, str) and hmac.compare_digest(signature, _signature_of(unsigned, key))


def own_code(config: Mapping[str, Any]) -> list[str]:
    """The names of code in a run's config that is not lemniscate's, nor was passed in this process."""
    names = [config.get("env"), config.get("network"), *(config.get("wrappers") or ())]
    return [str(name) for name in names if ":" in str(name) and not named.is_passed(str(name))]


def require_trusted(path: Path, code: Sequence[str], *, trusted: bool) -> None:
    """Raise `UserError` where what is at `path` names `code` that nobody vouches for."""
    if code and not trusted:
        raise UserError(
            f"{path} is not of this user and machine, and would execute code of its own: {', '.join(code)}. If you know"
            " that code, add --trust (in Python trust=True)."
        )


def _signature_of(record: Mapping[str, Any], key: bytes) -> str:
    return hmac.new(key, json.dumps(record, sort_keys=True).encode(), hashlib.sha256).hexdigest()


def _key() -> bytes:
    """This user's key, made where there is none yet; empty where it cannot be kept."""
    file = Path(os.environ.get("XDG_STATE_HOME") or Path.home() / ".local" / "state") / "lemniscate" / "key"
    try:
        if not file.exists():
            file.parent.mkdir(parents=True, exist_ok=True, mode=0o700)
            mine = file.with_name(f"key-{secrets.token_hex(8)}")
            with os.fdopen(os.open(mine, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600), "wb") as new:
                new.write(secrets.token_bytes(32))
            try:
                os.link(mine, file)  # whole, and never in the place of another process's
            except FileExistsError:
                pass
            finally:
                mine.unlink()
        return file.read_bytes()
    except (OSError, RuntimeError):  # RuntimeError: there is no home directory
        return b""

"""MuJoCo's warnings about the models of others."""

from collections.abc import Iterator
from contextlib import contextmanager


@contextmanager
def model_warnings_off() -> Iterator[None]:
    """No warnings of MuJoCo about models, which it writes on standard error and into a file where the command runs."""
    try:
        from mujoco import set_mju_user_warning  # pyright: ignore[reportAttributeAccessIssue]
    except ImportError:  # Gymnasium says what to install
        yield
        return
    set_mju_user_warning(lambda _: None)
    try:
        yield
    finally:
        set_mju_user_warning(None)

"""Policies on the Hugging Face Hub: their addresses, download and upload.

A policy there is a model repository whose root is a checkpoint. The files of a checkpoint, raw tensors and JSON, are
all that is ever downloaded; their hashes are checked where they are read. What they name as `module:name` is imported
from this computer, and only if the user trusts it: see `require_trusted`.
"""

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from os import PathLike
from pathlib import Path
from typing import Any

from lemniscate.errors import UserError, is_installed, missing_extra, prefix_errors
from lemniscate.run.checkpoint import FILES, MANIFEST
from lemniscate.system import named
from lemniscate.system.files import at_home

SCHEME = "hf:"
"""the first part of an address as a path"""

CHECKPOINT = (MANIFEST, *FILES)
"""the files that are downloaded"""

EXECUTABLE = (".bin", ".ckpt", ".joblib", ".pickle", ".pkl", ".pt", ".pth", ".py", ".zip")
"""endings of what other libraries store policies as, and which may execute code when it is read"""

REPLACED = ("export/*", "plots/*", "videos/*", "replay.mp4", "final.json")
"""the paths that belong to one upload: what the next one does not have of them is deleted"""

KEPT = (".gitattributes", "README.md", "LICENSE")
"""the files of a repository that is still empty"""

REASONS = {
    401: "refuses: it does not know your token; log in again with `hf auth login`, or renew HF_TOKEN",
    403: "refuses: your token has no right to it",
    429: "refuses: too many requests in a short time; try again later",
}
"""what the Hub means by a status"""


@dataclass(frozen=True)
class Address:
    """A policy on the Hub: the repository `user/name`, and a branch, a tag or a commit of it, by default its newest."""

    name: str
    revision: str | None = None

    def __str__(self) -> str:
        return f"hf://{self.name}" + (f"@{self.revision}" if self.revision else "")


def is_address(place: object) -> bool:
    """Whether a path, or a string, is the address of a policy on the Hub."""
    return isinstance(place, str | PathLike) and Path(place).parts[:1] == (SCHEME,)


def read_address(place: str | PathLike[str]) -> Address:
    """The parts of an address, `hf://user/name` or `hf://user/name@revision`. Raises `UserError` for another form."""
    given = "/".join(Path(place).parts[1:])  # where it is a `Path`, one slash has been made of two
    name, _, revision = given.partition("@")
    if name.count("/") != 1 or given.endswith("@"):
        raise UserError(f"hf://{given} is no address of a policy, such as hf://user/name or hf://user/name@revision.")
    return Address(name, revision or None)


def local_path(place: str | PathLike[str]) -> Path:
    """The path of a run or a checkpoint; for an address, of its downloaded checkpoint. Raises as `download`."""
    return download(read_address(place)) if is_address(place) else at_home(place)


def own_code(config: Mapping[str, Any]) -> list[str]:
    """The names of the code in a run's config that is not lemniscate's, nor was passed in this process."""
    names = [*map(config.get, ("env", "backend", "network")), *(config.get("wrappers") or ())]
    return [str(name) for name in names if ":" in str(name) and not named.is_passed(str(name))]


def require_trusted(code: Sequence[str], *, trust: bool) -> None:
    """Raise `UserError` where a downloaded policy names `code` of its own, and the user has not said to trust it."""
    if code and not trust:
        known = "If you know that code, add --trust (in Python trust=True)."
        raise UserError(f"The policy would execute code of its own: {', '.join(code)}. {known}")


def download(address: Address) -> Path:
    """Download the checkpoint that is at an address, unless the cache of `huggingface_hub` has that commit.

    Where the Hub cannot be reached, the commit downloaded last is taken.

    Raises:
        UserError: `huggingface_hub` is not installed; no such repository or revision, or one without a policy; the Hub
            refuses or cannot be reached.
    """
    with _answers(str(address)):
        from huggingface_hub import HfApi, cached_assets_path, get_cached_repo_tree, snapshot_download

        revision = HfApi().resolve_revision(address.name, revision=address.revision)
        folder = cached_assets_path("lemniscate", address.name, revision.resolved)
        with _quiet():  # regular files in a folder of their own: a checkpoint is not read through links
            snapshot_download(address.name, revision=revision, local_dir=folder, allow_patterns=[*CHECKPOINT])
        if any(not (folder / name).is_file() for name in CHECKPOINT):
            there = get_cached_repo_tree(address.name, revision=revision, local_dir=folder)
            listed = [file.path for file in there]
            missing = next(name for name in CHECKPOINT if name not in listed)
            if executable := [name for name in listed if name.endswith(EXECUTABLE)]:
                raise UserError(
                    f"The repository has no {missing} but {executable[0]}, which may execute code when it is read;"
                    " it is not downloaded. Only policies of lemniscate can be loaded."
                )
            raise UserError(f"The repository holds no policy of lemniscate: it has no {missing}.")
    return folder


def require_uploads(name: str) -> None:
    """Raise `UserError` where nothing can be uploaded to the repository `name`, as far as is seen from here."""
    with _answers(name):
        from huggingface_hub import get_token
        from huggingface_hub.utils import validate_repo_id

        if name.count("/") != 1:
            raise UserError("A repository on the Hub is named user/name.")
        validate_repo_id(name)
        if not get_token():
            raise UserError("To upload, log in with `hf auth login`, or set HF_TOKEN to a token that may write.")


def upload(folder: Path, name: str, private: bool) -> str:
    """Upload all files in `folder` into the model repository `name`, in one commit; it is created if need be.

    The folder has a checkpoint at its root, and a new repository is `private` if that is asked for. Returns the address
    of its page.

    Raises:
        UserError: the Hub refuses or cannot be reached; the repository holds something else than a policy, or is public
            where it is to be private.
    """
    with _answers(name), _quiet():
        from huggingface_hub import HfApi

        api = HfApi()
        page = api.create_repo(name, private=private or None, exist_ok=True)
        there = api.model_info(name)
        if private and not there.private:
            raise UserError("The repository is public already; make it private on its page, or choose another name.")
        listed = [file.rfilename for file in there.siblings or ()]
        others = [file for file in listed if file not in KEPT]
        if others and MANIFEST not in listed:
            raise UserError(f"The repository holds no policy of lemniscate but {others[0]}; choose another name.")
        said = "Upload a policy of lemniscate"
        api.upload_folder(repo_id=name, folder_path=folder, commit_message=said, delete_patterns=[*REPLACED])
    return str(page)


@contextmanager
def _answers(name: str) -> Iterator[None]:
    """Turns what the Hub refuses, and its silence, into a `UserError` that begins with `name`."""
    if not is_installed("huggingface_hub"):
        raise missing_extra("huggingface_hub", "hub")
    import httpx2
    from huggingface_hub import errors

    with prefix_errors(name):
        try:
            yield
        except UserError:
            raise
        except errors.RevisionNotFoundError:
            raise UserError("The repository on the Hub has no such revision.") from None
        except errors.RepositoryNotFoundError:
            sentence = "There is no such repository on the Hub, or you may not read it; `hf auth login` logs you in."
            raise UserError(sentence) from None
        except errors.HfHubHTTPError as error:
            status, message = error.response.status_code, error.server_message
            answer = f"answers with status {status}{f': {message}' if message else ''}"
            raise UserError(f"The Hub {REASONS.get(status, answer)}.") from None
        except (RuntimeError, ValueError) as error:
            reasons = [_first_line(known) for known in (error, error.__cause__) if known]
            raise UserError(f"{': '.join(reasons)}.") from error
        except (httpx2.HTTPError, OSError, errors.RevisionResolutionError) as error:
            if isinstance(error, OSError) and error.errno:  # of this machine's disk
                raise
            raise UserError(f"The Hub cannot be reached: {_first_line(error.__cause__ or error)}.") from error


def _first_line(error: BaseException) -> str:
    return str(error).strip().partition("\n")[0].rstrip(".:") or type(error).__name__


@contextmanager
def _quiet() -> Iterator[None]:
    """Turns off the progress bars of `huggingface_hub` and its warnings; a policy is small."""
    from huggingface_hub.utils import are_progress_bars_disabled, disable_progress_bars, enable_progress_bars, logging

    disabled, verbosity = are_progress_bars_disabled(), logging.get_verbosity()
    disable_progress_bars()
    logging.set_verbosity_error()
    try:
        yield
    finally:
        logging.set_verbosity(verbosity)
        if not disabled:
            enable_progress_bars()

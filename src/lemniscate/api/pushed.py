"""The verb that uploads a policy to the Hugging Face Hub: push."""

import shutil
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from lemniscate.api.policy import Trained, TrainedPolicy, algorithm_of, load, own_code, save
from lemniscate.api.results import FINAL_EPISODES, film_or_say, final_scores, scores_of
from lemniscate.errors import UserError
from lemniscate.hub import repository as hub
from lemniscate.report import pages
from lemniscate.run import checkpoint
from lemniscate.run.directory import CONFIG, FINAL
from lemniscate.system.console import say
from lemniscate.system.files import write_json


def push(run: Trained, name: str, *, private: bool = False, license: str | None = None, trust: bool = False) -> str:
    """Upload the policy of a run to the Hugging Face Hub, as the model repository `name`, in one commit.

    The files are those of `save`: raw tensors and JSON, each with its sha256. Beside them are a model card with the
    scores, the command that trains it again and the lines that load it; the final scores of the run, its figures
    (`plots/`), its newest film, or one that is made now if the environment can be rendered; and what
    `lemniscate export` wrote (`export/`), if it did. `load("hf://user/name")` loads the policy.

    Args:
        run: its directory or a checkpoint's, what `train` returned, or a policy.
        name: "user/name". A new repository is created, and a policy that is there is replaced.
        private: make a new repository private.
        license: as the Hub abbreviates it, such as "mit"; without, the card names none.
        trust: as in `load`.

    Returns:
        The address of the repository's page.

    Raises:
        UserError: `huggingface_hub` is not installed; no name of a repository; no token; no policy to upload; a Hub
            that refuses or cannot be reached; a repository that holds something else, or is public in spite of
            `private`.
    """
    hub.require_uploads(name)
    policy = load(run, trust=trust)
    with TemporaryDirectory() as temporary:
        folder = Path(temporary) / "policy"
        save(policy, folder)
        code = own_code(checkpoint.read(folder))
        path = policy.path if policy.path and (policy.path / CONFIG).is_file() else None
        for place, file in _shown(path).items() if path else ():
            (folder / place).parent.mkdir(parents=True, exist_ok=True)
            shutil.copyfile(file, folder / place)
        if not (path and pages.newest_film(path)):
            film_or_say(policy, folder / "videos" / "episode.gif")
        scores = _scores(policy, path)
        if scores:
            write_json(folder / FINAL, scores)
        own = {"step": policy.step, "scores": scores, "license": license, "code": code}
        pages.write_card(folder, name, algorithm_of(policy), policy.config, **own)
        return hub.upload(folder, name, private)


def _shown(run: Path) -> dict[str, Path]:
    """The files of a run that are uploaded beside its policy, by their paths in the repository; no links.

    They are the figures, the export where there is a whole one, and the newest film: a video by the name that the Hub
    plays, else in `videos/`.
    """
    files = [*(run / "plots").glob("*.png")]
    if (run / "export" / "policy.onnx").is_file():
        files += (run / "export").rglob("*")
    own = [file for file in files if file.is_file() and file.resolve() == run.resolve() / file.relative_to(run)]
    shown = {file.relative_to(run).as_posix(): file for file in own}
    if film := pages.newest_film(run):
        shown["replay.mp4" if film.suffix == ".mp4" else f"videos/{film.name}"] = film
    return shown


def _scores(policy: TrainedPolicy, run: Path | None) -> dict[str, Any] | None:
    """The final scores of a run, or those of a policy without one; none where it cannot be evaluated here."""
    try:
        if run:
            return final_scores(run)
        say(f"Evaluating the policy: {FINAL_EPISODES} episodes.")
        return scores_of(policy)
    except UserError as error:
        say(f"No scores: {error}")
        return None

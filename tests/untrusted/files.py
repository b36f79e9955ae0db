"""Copies of the kept files with one thing wrong, and a look at the whole disk below a folder."""

import hashlib
import json
import shutil
import sys
from pathlib import Path

DATA = Path(__file__).resolve().parents[1] / "data"
sys.path.insert(0, str(DATA))

from make import WORDS  # noqa: E402


def tree(folder):
    """Every path below a folder, with what it is and a hash of what it holds."""
    found = {}
    for path in sorted(Path(folder).rglob("*")):
        name = path.relative_to(folder).as_posix()
        if path.is_symlink():
            found[name] = f"link to {path.readlink()}"
        elif path.is_file():
            found[name] = hashlib.sha256(path.read_bytes()).hexdigest()
        else:
            found[name] = "folder"
    return found


def kept(name, change=lambda folder: None):
    """A copy of one of the kept folders, changed."""
    if not Path(name).exists():
        shutil.copytree(DATA / name, name)
    change(Path(name))
    return name


def words(*changed):
    """The words of the kept run, some of them changed."""
    keys = {word.partition("=")[0] for word in changed}
    return ["run", "giril", *(w for w in WORDS if w.partition("=")[0] not in keys), *changed]


def demonstration(change):
    """Words of a run whose demonstration has other tensors, metadata in order."""

    def rewrite(folder):
        from giril_rl.demos.storage import load_tensors, save_tensors

        data = load_tensors(folder / "transitions")
        changed = change(data)
        shutil.rmtree(folder / "transitions")
        save_tensors(folder / "transitions", data if changed is None else changed)

    kept("demonstration", rewrite)
    return words()


def spoilt_demonstration(change):
    """Words of a run whose demonstration's files are changed."""
    kept("demonstration", change)
    return words()


def run_folder(change=lambda folder: None, finished=True):
    """The kept run as if made here, changed."""
    from giril_rl.files.disk import write_json
    from giril_rl.runs.finished import RUN_FORMAT
    from giril_rl.runs.machine import installed_versions

    def ready(folder):
        (folder / ".lock").touch()
        write_json(folder / "versions.json", {"format_version": RUN_FORMAT, **installed_versions()})
        if not finished:
            (folder / "result.json").unlink()
        change(folder)

    kept("demonstration")
    return kept("run", ready)


def resumed(change):
    """Words that continue the kept run, unfinished and changed."""
    run_folder(change, finished=False)
    return words()


def cut(name):
    def change(folder):
        content = (folder / name).read_bytes()
        (folder / name).write_bytes(content[: len(content) // 2])

    return change


def gone(name):
    return lambda folder: (folder / name).unlink()


def text(name, content):
    return lambda folder: (folder / name).write_text(content)


def entries(name, drop=(), **changed):
    """Changes a JSON object's entries."""

    def change(folder):
        path = folder / name
        value = json.loads(path.read_text())
        value = {key: inner for key, inner in value.items() if key not in drop}
        path.write_text(json.dumps({**value, **changed}))

    return change


def written(name, content):
    """Writes a file here, text or bytes, and returns its name."""
    Path(name).write_bytes(content if isinstance(content, bytes) else content.encode())
    return name


def recipe(settings, python=None):
    """A copied recipe with these settings."""
    python = (DATA.parents[1] / "recipes/giril.py").read_bytes() if python is None else python
    written("mine.py", python)
    written("mine.yaml", settings)
    return ["run", "mine.py"]


SETTINGS = "defaults:\n  - recipe_schema\n  - task: inverted_pendulum\n  - _self_\nsteps: 2000\n"

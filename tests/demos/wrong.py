"""Writers of data sets with one thing wrong, each returning what to import."""

import io
import json
import pickle
import zipfile
from pathlib import Path

import datasets
import numpy as np
import pytest


class Evil:
    """Leaves a file behind where it is unpickled."""

    def __init__(self, mark="mark"):
        self.mark = str(mark)

    def __reduce__(self):
        return Path.touch, (Path(self.mark),)


def columns(**changes):
    return npz(datasets.columns(), changes)


def whole(**changes):
    return npz(datasets.whole(), changes)


def renamed(arrays, **names):
    return npz({names.get(name, name): value for name, value in arrays.items()}, {})


def npz(arrays, changes):
    """Writes changed arrays: None drops one, a function changes it, all else replaces it."""
    for name, change in changes.items():
        arrays[name] = change(arrays[name].copy()) if callable(change) else change
    np.savez("set.npz", **{name: value for name, value in arrays.items() if value is not None})
    return "set.npz"


def put(index, value):
    def change(array):
        array[index] = value
        return array

    return change


def minari(change=None, **metadata):
    pytest.importorskip("h5py")
    parts = datasets.episodes()
    if change:
        change(parts)
    datasets.write_minari(Path("minari"), "set-v0", parts, **metadata)
    return "minari:set-v0"


def first(key, change):
    """Changes one array of the first episode of a Minari dataset."""

    def edit(parts):
        parts[0][key] = change(parts[0][key].copy())

    return lambda: minari(edit)


def hdf5(edit):
    import h5py

    source = minari()
    with h5py.File("minari/set-v0/data/main_data.hdf5", "a") as file:
        del file["episode_0/actions"]
        edit(h5py, file["episode_0"])
    return source


def memmap(change=lambda data: None, then=lambda folder: None):
    data = datasets.tensors()
    changed = change(data)
    data = data if changed is None else changed
    data.memmap("folder", copy_existing=True)
    then(Path("folder"))
    return "folder"


def without(key):
    return lambda data: data.exclude(key)


def with_value(key, change):
    return lambda data: data.set(key, change(data.get(key).clone()))


def raw(name, content):
    Path(name).write_bytes(content)
    return name


def cut_short(name):
    content = Path(name).read_bytes()
    Path(name).write_bytes(content[: len(content) // 2])


def half(write, name):
    source = write()
    cut_short(name)
    return source


def archive(**members):
    """An .npz with members of any name and content."""
    columns()
    with zipfile.ZipFile("set.npz", "a") as file:
        for name, content in members.items():
            file.writestr(name.replace("__", "/"), content)
    return "set.npz"


def bomb():
    """A member whose header asks for more than the file holds."""
    header = io.BytesIO()
    declared = {"descr": "<f4", "fortran_order": False, "shape": (10**12, 3)}
    np.lib.format.write_array_header_1_0(header, declared)
    columns(observation=None)
    with zipfile.ZipFile("set.npz", "a") as file:
        file.writestr("observation.npy", header.getvalue() + b"\0" * 12)
    return "set.npz"


def objects():
    return np.array([Evil(), Evil(), Evil(), Evil(), Evil()], dtype=object)


def huge(h5py, group):
    group.create_dataset("actions", (10**12, 1), "f4", chunks=(10**4, 1))


def external(h5py, group):
    group["actions"] = h5py.ExternalLink("../../secret.hdf5", "x")


def soft(h5py, group):
    group["actions"] = h5py.SoftLink("/episode_1/actions")


def elsewhere(h5py, group):
    group.create_dataset("actions", (3, 1), "f4", external=[("../../../../secret.npy", 0, 12)])


def texts(h5py, group):
    group.create_dataset("actions", data=[b"a", b"b", b"c"])


def parts(h5py, group):
    group.create_group("actions")


def link(folder):
    (folder / "action.memmap").rename("away")
    (folder / "action.memmap").symlink_to(Path("away").resolve())


def meta(**entries):
    def change(folder):
        path = folder / "meta.json"
        path.write_text(json.dumps({**json.loads(path.read_text()), **entries}))

    return lambda: memmap(then=change)


STRAY = {"device": "cpu", "shape": [3], "dtype": "torch.float32", "is_nested": False}


def stray(folder):
    (folder / "other.pickle").write_bytes(pickle.dumps(Evil()))

import pytest
import torch
from tensordict import TensorDict

from giril_rl.demos import Demonstration, holdout, subsample
from giril_rl.errors import UserError


def flat(length):
    return Demonstration(TensorDict({"index": torch.arange(length)}, [length]))


def test_paper_keeps_fifty_of_a_thousand():
    kept = subsample(flat(1000), 20)["index"]
    assert kept.tolist() == list(range(0, 1000, 20))
    assert len(kept) == 50


@pytest.mark.parametrize(("every", "offset"), [(1, 0), (4, 0), (4, 3), (7, 2), (30, 12)])
def test_parts_are_disjoint_and_complete(every, offset):
    kept = subsample(flat(13), every, offset)["index"].tolist()
    left = holdout(flat(13), every, offset)["index"].tolist()
    assert kept == list(range(13))[offset::every]
    assert sorted(kept + left) == list(range(13))


def test_pairs_stay_together(demo):
    kept = subsample(demo, 5)
    for position, index in enumerate([0, 5, 10]):
        assert (kept[position] == demo.transitions[index]).all()
    kept["action"].zero_()
    assert (demo.transitions["action"] != 0).all()


@pytest.mark.parametrize(("every", "offset"), [(0, 0), (-2, 0), (4, 4), (4, -1), (30, 13)])
def test_nonsense_is_refused(every, offset):
    with pytest.raises(UserError, match=f"subsample={every}"):
        subsample(flat(13), every, offset)

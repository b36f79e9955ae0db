import pytest
import torch

from giril_rl.training.threads import made_on_one_thread


@pytest.fixture
def three():
    before = torch.get_num_threads()
    torch.set_num_threads(3)
    yield
    torch.set_num_threads(before)


def numbers(fails=False):
    for number in range(2):
        yield number, torch.get_num_threads()
    if fails:
        raise RuntimeError("no more")


def test_items_are_made_on_one_thread_and_used_on_all(three):
    seen = [(*made, torch.get_num_threads()) for made in made_on_one_thread(numbers())]
    assert seen == [(0, 1, 3), (1, 1, 3)]
    assert torch.get_num_threads() == 3


def test_threads_are_given_back_after_an_error(three):
    with pytest.raises(RuntimeError, match="no more"):
        list(made_on_one_thread(numbers(fails=True)))
    assert torch.get_num_threads() == 3

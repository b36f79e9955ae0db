"""What is shown of single transitions, and how."""

import numpy as np
import pytest
import torch
from tensordict import TensorDict
from torchrl.data import Categorical

from giril_rl.experiments.report.predictions import draw_predictions, foresee
from giril_rl.rewards import GenerativeReward

NAMES = ["NOOP", "FIRE", "DOWNRIGHTFIRE"]


def shown(beta, scale=1.0, clamp=True, title="policy"):
    model = GenerativeReward.for_pixels(Categorical(3), beta=beta, scale=scale, clamp=clamp).eval()
    generator = torch.Generator().manual_seed(0)
    frames = torch.randint(0, 256, (2, 3, 4, 84, 84), generator=generator).to(torch.uint8)
    data = TensorDict(
        {
            "observation": frames[0],
            "action": torch.tensor([2, 0, 1]),
            "next": TensorDict({"observation": frames[1]}, [3]),
            "done": torch.zeros(3, 1),
        },
        [3],
    )
    labels = ["game 1\nstep 1,234\nnot fitted", "step 2", "step 3"]
    found = foresee(model, data, title=title, labels=labels, actions=NAMES)
    return found, data


@pytest.mark.parametrize(("beta", "scale", "clamp"), [(1, 1.0, True), (0.7, 3.0, False)])
def test_the_reward_is_that_of_the_prediction_that_is_shown(beta, scale, clamp):
    found, data = shown(beta, scale, clamp)
    assert found.actions == ["DOWNRIGHTFIRE", "NOOP", "FIRE"]
    assert np.array_equal(found.observation, data["observation"][:, -1].numpy())
    fresh = GenerativeReward.for_pixels(Categorical(3), beta=beta, clamp=clamp).eval()
    with torch.no_grad():
        predicted = fresh.predict(data["observation"], data["action"], data["next", "observation"])
    following = data["next", "observation"].float() / 127.5 - 1
    errors = (predicted - following).square().sum((1, 2, 3))
    assert np.allclose(found.rewards, scale * errors.numpy(), rtol=1e-5)
    last = (predicted - following).square()[:, -1].numpy()
    assert np.allclose(found.errors, last, atol=1e-5)


def test_no_two_texts_overlap(monkeypatch, tmp_path):
    from matplotlib.figure import Figure

    figures, savefig = [], Figure.savefig
    monkeypatch.setattr(
        Figure, "savefig", lambda self, *a, **k: (savefig(self, *a, **k), figures.append(self))
    )
    groups = [shown(1, title="demonstration")[0], shown(1, scale=1e-6)[0]]
    draw_predictions(groups, "a title", tmp_path / "picture.png")
    (figure,) = figures
    assert (tmp_path / "picture.png").read_bytes().startswith(b"\x89PNG")
    images = [axes for axes in figure.axes if axes.images]
    assert len(images) == 4 * 6
    places = [axes.get_window_extent() for axes in images]
    places += [text.get_window_extent() for text in figure.texts]
    for number, place in enumerate(places):
        assert figure.bbox.x0 <= place.x0 and place.x1 <= figure.bbox.x1
        assert not any(place.overlaps(other) for other in places[:number])
    limits = {axes.images[0].get_clim() for axes in images[3::4]}
    assert len(limits) == 1  # One scale of the error for all rows.
    assert [t.get_text() for t in figure.texts if t.get_text().startswith("reward")][3:]

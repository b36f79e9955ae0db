"""Each run begins and ends its own run of a logger, by fakes of the two services' clients."""

import importlib
import sys
from importlib.machinery import ModuleSpec
from types import ModuleType, SimpleNamespace

import pytest

from giril_rl.runs.interrupt import Interrupted
from giril_rl.runs.run import Run


class FakeWandb(ModuleType):
    """Hands out the run that is open unless asked for a new one, as the client does."""

    class Run:
        def __init__(self, name, id, **kwargs):
            self.name, self.id, self.rows, self.exit_code = name, id, [], None
            self.config = SimpleNamespace(update=lambda *args, **kwargs: None)

        def define_metric(self, *args, **kwargs):
            pass

        def log(self, row, **kwargs):
            assert self.exit_code is None, "it has ended"
            self.rows.append({k: v for k, v in row.items() if not k.endswith("step")})

        def finish(self, exit_code):
            self.exit_code = exit_code

    def __init__(self):
        super().__init__("wandb")
        self.runs = []

    def init(self, *, reinit=None, **kwargs):
        opened = [run for run in self.runs if run.exit_code is None]
        if not opened or reinit == "create_new":
            self.runs.append(self.Run(**kwargs))
        return self.runs[-1]

    def found(self):
        status = {None: "RUNNING", 0: "FINISHED", 1: "FAILED", 130: "KILLED"}
        rows: dict = {}
        for run in self.runs:  # A run of the same id continues.
            known = rows.setdefault(run.id, [run.name, None, []])
            known[1] = status[run.exit_code]
            known[2] += run.rows
        return [tuple(row) for row in rows.values()]


class FakeMLflow(ModuleType):
    """Keeps its runs by the place that they are written to."""

    def __init__(self):
        super().__init__("mlflow")
        self.entities = ModuleType("mlflow.entities")
        self.entities.Metric = lambda key, value, timestamp, step: {key: value}
        self.stores = stores = {}

        class MlflowClient:
            def __init__(self, tracking_uri):
                self.runs = stores.setdefault(tracking_uri, [])

            def get_experiment_by_name(self, name):
                return SimpleNamespace(experiment_id="1") if self.runs else None

            def create_experiment(self, name, artifact_location):
                return "1"

            def search_runs(self, experiments, text):
                identity = text.partition(" = ")[2].strip("'")
                return [run for run in self.runs if identity in run.tags.values()]

            def create_run(self, experiment, *, tags, run_name):
                info = SimpleNamespace(run_id=len(self.runs), name=run_name, status="RUNNING")
                self.runs.append(SimpleNamespace(info=info, tags=tags, rows=[]))
                return self.runs[-1]

            def update_run(self, run_id, status):
                self.runs[run_id].info.status = status

            def log_batch(self, run_id, metrics):
                assert self.runs[run_id].info.status == "RUNNING", "it has ended"
                self.runs[run_id].rows.append({k: v for row in metrics for k, v in row.items()})

            set_terminated = update_run

        self.MlflowClient = MlflowClient

    def found(self):
        runs = [run for store in self.stores.values() for run in store]
        return [(run.info.name, run.info.status, run.rows) for run in runs]


@pytest.fixture(params=[FakeWandb, FakeMLflow])
def service(request, monkeypatch):
    fake = request.param()
    fake.__spec__ = ModuleSpec(fake.__name__, None)
    monkeypatch.setitem(sys.modules, fake.__name__, fake)
    if isinstance(fake, FakeMLflow):
        monkeypatch.setitem(sys.modules, "mlflow.entities", fake.entities)
        monkeypatch.delenv("MLFLOW_TRACKING_URI", raising=False)
    else:
        module = importlib.import_module("torchrl.record.loggers.wandb")
        monkeypatch.setattr(module, "_has_wandb", True)
    return fake


def opened(service, folder):
    return Run.open(folder, {}, recipe="x", logger=service.__name__)


def test_expert_run_and_next_job_have_a_run_each(service, tmp_path):
    with opened(service, tmp_path / "first") as run:
        run.log(1, {"fit/loss": 0.25}, phase="fit")  # Open beside the expert's.
        with opened(service, tmp_path / "expert") as expert:
            expert.log(1, {"ppo/loss": 1.0, "ppo/kl": 2.0}, phase="ppo")
        run.log(2, {"fit/loss": 0.5}, phase="fit")
    with opened(service, tmp_path / "second") as run:
        run.log(1, {"fit/loss": 4.0}, phase="fit")
    assert sorted(service.found()) == [
        ("expert", "FINISHED", [{"ppo/loss": 1.0, "ppo/kl": 2.0}]),
        ("first", "FINISHED", [{"fit/loss": 0.25}, {"fit/loss": 0.5}]),
        ("second", "FINISHED", [{"fit/loss": 4.0}]),
    ]


@pytest.mark.parametrize(("error", "status"), [(ValueError, "FAILED"), (Interrupted, "KILLED")])
def test_a_run_that_stopped_says_so_and_continues_the_same(service, error, status, tmp_path):
    with pytest.raises(error), opened(service, tmp_path / "a") as run:
        run.log(1, {"loss": 1.0}, phase="ppo")
        raise error
    assert service.found() == [("a", status, [{"loss": 1.0}])]
    with opened(service, tmp_path / "a") as run:
        run.log(2, {"loss": 2.0}, phase="ppo")
    assert service.found() == [("a", "FINISHED", [{"loss": 1.0}, {"loss": 2.0}])]


@pytest.mark.slow
def test_with_the_real_mlflow(tmp_path, monkeypatch):
    mlflow = pytest.importorskip("mlflow")
    monkeypatch.chdir(tmp_path)
    monkeypatch.delenv("MLFLOW_TRACKING_URI", raising=False)
    for step in (1, 2):
        with Run.open(tmp_path / "a", {}, recipe="x", logger="mlflow") as run:
            run.log(step, {"ppo/loss": float(step)}, phase="ppo")
            with Run.open(tmp_path / f"b{step}", {}, recipe="x", logger="mlflow") as other:
                other.log(step, {"ppo/loss": 10.0 * step}, phase="ppo")
    found = {}
    for store in tmp_path.glob("*/mlflow/mlflow.db"):
        client = mlflow.MlflowClient(f"sqlite:///{store}")
        (experiment,) = (e for e in client.search_experiments() if e.name == "giril_rl")
        (run,) = client.search_runs([experiment.experiment_id])
        history = client.get_metric_history(run.info.run_id, "ppo/loss")
        rows = [(row.step, row.value) for row in history]
        found[store.parent.parent.name] = run.info.run_name, run.info.status, rows
    assert found == {
        "a": ("a", "FINISHED", [(1, 1.0), (2, 2.0)]),
        "b1": ("b1", "FINISHED", [(1, 10.0)]),
        "b2": ("b2", "FINISHED", [(2, 20.0)]),
    }
    assert {path.name for path in tmp_path.iterdir()} == {"a", "b1", "b2"}

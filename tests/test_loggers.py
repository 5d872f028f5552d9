import importlib
import json
import math
import struct
import sys

import pytest

from jaxswarm.config import ConfigError
from jaxswarm.host.loggers import LOGGERS

ROWS = [
    {"update": 0, "agent_steps": 0, "wall_seconds": 0.5, "seed": 3, "eval/return": -9.0, "learner/loss": math.nan},
    {"update": 5, "agent_steps": 500, "wall_seconds": 1.5, "seed": 3, "eval/return": -4.5, "learner/loss": 0.25},
]
EXPECTED = [(0, "eval/return", -9.0), (500, "eval/return", -4.5), (500, "learner/loss", 0.25)]


def records(path):
    """Return the contents of the records of a TensorBoard file: length, its checksum, content, its checksum."""
    data = path.read_bytes()
    while data:
        (length,) = struct.unpack("<Q", data[:8])
        yield data[12 : 12 + length]
        data = data[12 + length + 4 :]


def chunks(path):
    """Return the contents of a W&B file.

    The file has 7 bytes, then blocks of 32 KiB with parts of checksum, length, kind and content.
    """
    data, position, content = path.read_bytes(), 7, b""
    while position + 7 <= len(data):
        if position % 32768 > 32768 - 7:
            position += -position % 32768
            continue
        length, kind = struct.unpack("<HB", data[position + 4 : position + 7])
        content += data[position + 7 : position + 7 + length]
        position += 7 + length
        if kind in (1, 4):  # a complete record, or its last part
            yield content
            content = b""


def test_tensorboard_has_a_stream_of_each_seed(tmp_path):
    pytest.importorskip("tensorboardX", reason="the extra tensorboard is not installed")
    events = importlib.import_module("tensorboardX.proto.event_pb2")
    loggers = [LOGGERS["tensorboard"](tmp_path, {"task": {"name": "rendezvous"}}, seed) for seed in (3, 4)]
    for row in ROWS:
        loggers[0].log(row)
    for logger in loggers:
        logger.close()
    (path,) = (tmp_path / "tensorboard" / "seed_3").iterdir()
    found = [events.Event.FromString(record) for record in records(path)]
    values = [(event.step, value.tag, value) for event in found for value in event.summary.value]
    scalars = [(step, tag, value.simple_value) for step, tag, value in values if value.HasField("simple_value")]
    assert sorted(x for x in scalars if x[1] not in ("update", "wall_seconds")) == sorted(EXPECTED)
    assert (500, "wall_seconds", 1.5) in scalars
    assert any(b"rendezvous" in text for _, _, value in values for text in value.tensor.string_val)
    assert (tmp_path / "tensorboard" / "seed_4").is_dir()


def test_weights_and_biases_works_offline(tmp_path, monkeypatch):
    wandb = pytest.importorskip("wandb", reason="the extra wandb is not installed")
    messages = importlib.import_module("wandb.proto.wandb_internal_pb2")
    for name, value in {"WANDB_MODE": "offline", "WANDB_ERROR_REPORTING": "false", "HOME": str(tmp_path)}.items():
        monkeypatch.setenv(name, value)
    run_dir = tmp_path / "run"
    loggers = [LOGGERS["wandb"](run_dir, {"num_envs": 32}, seed) for seed in (3, 4)]
    for row in ROWS:
        loggers[0].log(row)
    for logger in loggers:
        logger.close()
    LOGGERS["wandb"](run_dir, None, 4).close()  # as a resumed run does
    wandb.teardown()
    found, ids = {}, {}
    for path in (run_dir / "wandb").glob("offline-run-*/*.wandb"):
        kept = [messages.Record.FromString(chunk) for chunk in chunks(path)]
        (run,) = (record.run for record in kept if record.WhichOneof("record_type") == "run")
        history = [record.history for record in kept if record.WhichOneof("record_type") == "history"]
        items = [{item.nested_key[0] or item.key: json.loads(item.value_json) for item in x.item} for x in history]
        assert run.run_id not in ids or ids[run.run_id] == run.display_name
        ids[run.run_id] = run.display_name
        found[run.display_name] = (run, items)
    assert found.keys() == {"run-seed3", "run-seed4"}
    assert len(ids) == 2
    run, items = found["run-seed3"]
    assert (run.project, run.run_group) == ("jaxswarm", "run")
    values = [(x["agent_steps"], name, x[name]) for x in items for name in ("eval/return", "learner/loss") if name in x]
    assert values == EXPECTED
    assert found["run-seed4"][1] == []


@pytest.mark.parametrize(("name", "package"), [("tensorboard", "tensorboardX"), ("wandb", "wandb")])
def test_a_missing_package_names_the_extra(tmp_path, monkeypatch, name, package):
    monkeypatch.setitem(sys.modules, package, None)
    with pytest.raises(ConfigError, match=rf'pip install "jaxswarm\[{name}\]"'):
        LOGGERS[name](tmp_path, None, 0)

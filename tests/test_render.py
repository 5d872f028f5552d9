"""Tests of films, which record complete episodes with the weights of the network, and of pages and image files."""

import base64
import dataclasses
import html
import json
import re
import shutil
import types
import zlib

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from example_films import episode
from PIL import Image

from jaxswarm import config as configs
from jaxswarm import render
from jaxswarm.cli import render as program
from jaxswarm.distributions import gaussian
from jaxswarm.render import page
from jaxswarm.render.film import MAX_SHARES
from jaxswarm.scene import Bodies, Scene
from jaxswarm.training import init
from jaxswarm.types import Entities, Observation, Step, pytree, static


@pytree
class Clock:
    time: jax.Array


@pytree
class Countdown:
    """A task that terminates after `length` steps, with the step number as reward; no agent perceives the third."""

    length: int = 4
    num_agents: int = static(default=3)
    episode_length: int = static(default=9)

    def reset(self, key):
        return Clock(jnp.zeros((), jnp.int32))

    def step(self, key, state, action):
        is_over = state.time + 1 >= self.length
        return Clock(state.time + 1), Step(state.time + 1.0, is_over, is_over, {})

    def observe(self, state):
        mask = self.slots(state)["neighbors"] < 2
        return Observation(jnp.zeros((3, 1)), {"neighbors": Entities(jnp.zeros((3, 2, 1)), mask)})

    def slots(self, state):
        return {"neighbors": jnp.array([[1, 2], [2, 0], [0, 1]])}

    def scene(self, state):
        agents = Bodies(jnp.full((3, 2), state.time), jnp.ones(3, bool))
        return Scene(jnp.zeros(2), jnp.ones(2), False, agents)


class Standing:
    """A network with zero actions and fixed weights."""

    def apply(self, params, obs, method):
        if method == "weights":
            return {"neighbors": jnp.array([[1.0, 0.0], [0.0, 1.0], [0.25, 0.75]])}
        zeros = jnp.zeros((*obs.own.shape[:-1], 2))
        return gaussian(zeros, zeros)


def test_a_film_ends_where_the_episode_ends():
    film = render.record(Countdown(), Standing(), None, max_shares=1)
    np.testing.assert_array_equal(film.score, [0, 1, 3, 6, 10])
    np.testing.assert_array_equal(film.scenes.agents.position[:, 0, 0], [0, 1, 2, 3, 4])
    assert film.shares is None  # the shares of two frames exceed the limit


@pytest.mark.parametrize(("length", "kept"), [(100, 5), (4, 3)])
def test_shares_are_kept_of_so_many_frames_and_by_the_number_of_the_body(length, kept):
    film = render.record(Countdown(length), Standing(), None, max_shares=5 * 9)
    assert film.num_frames == min(length, 9) + 1
    assert film.shares_every == 2
    expected = [[np.nan, 1, np.nan], [1, np.nan, np.nan], [0.25, 0.75, np.nan]]
    np.testing.assert_array_equal(film.shares, [expected] * kept)


def unpack(text):
    metadata = json.loads(re.search(r'<script id="metadata"[^>]*>(.*?)</script>', text, re.S)[1])
    data = re.search(r'<script id="data"[^>]*>(.*?)</script>', text, re.S)[1]
    return metadata, zlib.decompress(base64.b64decode(data))


@pytest.mark.parametrize("kinds", [{"num_evaders": 2}, {"num_boxes": 4}])
def test_a_page_holds_what_the_film_shows(kinds):
    film = episode(**kinds)
    metadata, data = unpack(page.html([film, film]))
    assert [x["title"] for x in metadata["films"]] == [film.title] * 2
    second = metadata["films"][1]
    arrays = {name: np.frombuffer(data[a:b], page.TYPES[dtype]) for name, (a, b, dtype) in second["arrays"].items()}
    for role, bodies in film.scenes.kinds.items():
        codes = arrays[f"{role}.position"].reshape(bodies.position.shape)
        np.testing.assert_allclose(codes / 65534 * 100, bodies.position, atol=100 / 65534)
        assert second["kinds"][role]["count"] == bodies.position.shape[1]
    heading = arrays["agents.heading"].reshape(film.scenes.agents.heading.shape) * (np.pi / 128)
    assert np.cos(heading - film.scenes.agents.heading).min() > np.cos(np.pi / 255)
    shares = ((arrays["shares"].reshape(film.shares.shape).astype(float) - 1) / 254) ** 4
    np.testing.assert_allclose(shares, film.shares, rtol=0.03, atol=1e-4)
    np.testing.assert_allclose(arrays["score"], film.score, rtol=1e-6)
    assert len(second["catches"]) == ("num_evaders" in kinds)
    assert [goal["group"] for goal in second["goals"]] == ([0, 1] if "num_boxes" in kinds else [])


def test_absent_bodies_and_those_not_perceived_have_codes_of_their_own():
    position, low, high = np.array([[0.0, 0.0], [1.0, 1.0], [0.5, 0.5]]), np.zeros(2), np.ones(2)
    codes = page.quantize_positions(position, np.array([True, True, False]), low, high)
    np.testing.assert_array_equal(codes, [[0, 0], [65534, 65534], [65535, 65535]])
    np.testing.assert_array_equal(page.quantize_shares(np.array([np.nan, 0.0, 1.0])), [0, 1, 255])


def test_a_page_asks_for_nothing_from_outside():
    text = page.html([episode()])
    assert not re.findall(r"(?:src|href)\s*=\s*[\"'](?!data:)|https?://|@import|fetch\(|localStorage", text)
    assert text.count("</script>") == 4  # titles cannot end a script


def test_a_page_inside_of_a_notebook_is_the_page():
    films = [episode()]
    text = render.iframe(films, height=500)
    (source,) = re.findall(r'srcdoc="([^"]*)"', text)
    assert html.unescape(source) == page.html(films)
    assert 'height="500"' in text


@pytest.mark.parametrize("kept", [True, False])
def test_large_swarms_stay_below_10_mb(kept):
    """The film has 200 agents, 1024 steps and random numbers, which compress worst."""
    film = episode(1025, 200, shares=False)
    if kept:
        every = -(-1025 // (MAX_SHARES // 200**2))
        shares = np.random.default_rng(0).dirichlet(np.ones(200), (-(-1025 // every), 200))
        film = dataclasses.replace(film, shares=shares, shares_every=every)
    assert len(page.html([film])) < 10e6


@pytest.mark.parametrize("kinds", [{"num_evaders": 2}, {"num_boxes": 4}])
def test_a_strip_has_a_row_for_each_film(kinds, tmp_path):
    render.write(tmp_path / "a.png", [episode(**kinds)], frames=3, until=20)
    render.write(tmp_path / "b.png", [episode(**kinds), episode(seed=1)], frames=3)
    with Image.open(tmp_path / "a.png") as one, Image.open(tmp_path / "b.png") as two:
        assert one.width == two.width
        assert two.height == 2 * one.height
        assert len(one.convert("RGB").getcolors(2**24)) > 50
    assert sorted(path.name for path in tmp_path.iterdir()) == ["a.png", "b.png"]


def test_suffixes_may_be_in_capitals_and_paths_texts(tmp_path):
    render.write(str(tmp_path / "A.HTML"), [episode()])
    assert [path.name for path in tmp_path.iterdir()] == ["A.HTML"]


def test_a_gif_has_the_given_number_of_frames(tmp_path):
    render.write(tmp_path / "a.gif", [episode(num_evaders=1)], frames=4)
    with Image.open(tmp_path / "a.gif") as image:
        assert image.n_frames == 4
        assert image.info["duration"] == 50


@pytest.mark.skipif(not shutil.which("ffmpeg"), reason="ffmpeg is not installed")
def test_an_mp4_is_written_by_ffmpeg(tmp_path):
    render.write(tmp_path / "a.mp4", [episode(num_evaders=1)], until=3)
    assert b"ftyp" in (tmp_path / "a.mp4").read_bytes()[:12]


@pytest.mark.parametrize(
    ("name", "options", "part"),
    [
        ("a.jpg", {}, ".html, .png, .gif, .mp4"),
        ("a.html", {"frames": 3}, "frames: must be used with .png, .gif, got .html"),
        ("a.mp4", {}, "ffmpeg"),
    ],
)
def test_what_cannot_be_written_is_said(name, options, part, tmp_path, monkeypatch):
    monkeypatch.setenv("PATH", "")
    with pytest.raises(render.RenderError, match=re.escape(part)):
        render.write(tmp_path / name, [episode()], **options)
    assert not list(tmp_path.iterdir())


def test_a_replay_in_the_run_folder(run_dir):
    experiment = configs.build(configs.load(run_dir / "config.yaml"))
    params = init(experiment, jax.random.key(0)).learner.params
    path = render.write_replay(run_dir, experiment, params, update=7)
    (film,) = unpack(path.read_text())[0]["films"]
    assert film["title"] == "rendezvous of 3 agents, after update 7"
    assert film["frames"] == 6


def test_runs_are_rendered_side_by_side(run_dir, tmp_path, capsys):
    assert program.main([str(run_dir), str(run_dir), "checkpoint=last", "seed=2", f"out={tmp_path / 'two.html'}"]) == 0
    metadata = unpack((tmp_path / "two.html").read_text())[0]
    assert [film["title"] for film in metadata["films"]] == ["run, rendezvous of 3 agents, after update 1"] * 2
    assert "5 steps, return -" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("overrides", "part"),
    [
        (["out=a.jpg"], "out: must end in one of .html"),
        (["checkpoint=first"], "must be one of best, last"),
        (["frames=0", "out=a.png"], "frames: must be an integer >= 1, got"),
        (["frames=3"], "frames: must be used with"),
        (["num_envs=3"], "num_envs cannot be changed here"),
        (["task.dynamics=velocity"], "observations of other sizes"),
        (["nowhere"], "nowhere is not a run folder"),
    ],
)
def test_a_wrong_command_is_one_line(run_dir, capsys, overrides, part):
    assert program.main([str(run_dir), *overrides]) == 2
    err = capsys.readouterr().err
    assert part in err
    assert err.count("\n") == 1


def test_replays_are_numbered_and_a_replaced_file_is_reported(run_dir, tmp_path, capsys):
    folder = shutil.copytree(run_dir, tmp_path / "run")
    (folder / "replay.html").write_text("of training")
    assert program.main([str(folder)]) == 0
    assert f"wrote {folder / 'replay-2.html'}" in capsys.readouterr().out
    assert program.main([str(folder)]) == 0
    assert f"wrote {folder / 'replay-3.html'}" in capsys.readouterr().out
    assert (folder / "replay.html").read_text() == "of training"
    assert program.main([str(folder), f"out={folder / 'replay.html'}"]) == 0
    assert f"replaced {folder / 'replay.html'}" in capsys.readouterr().out


def test_training_does_not_fail_by_a_replay(run_dir, capsys):
    experiment = configs.build(configs.load(run_dir / "config.yaml"))
    assert render.write_replay(run_dir, experiment, {"params": {}}, update=1, name="broken.html") is None
    assert "warning: no broken.html: " in capsys.readouterr().err
    assert not (run_dir / "broken.html").exists()


def test_replays_are_written_at_every_so_many_evaluations(tmp_path, monkeypatch):
    written = []
    monkeypatch.setattr(render, "write_replay", lambda *_, update, name: written.append((update, name)))
    experiment = types.SimpleNamespace(eval_every=10)
    on_evaluation = render.hook(tmp_path, experiment, 2)
    for update in (0, 10, 20, 30):
        on_evaluation(update, {"w": np.zeros((3, 2))})
    assert written == [(0, "replay-0.html"), (20, "replay-20.html")]

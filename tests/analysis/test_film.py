"""`train.py render`: the states it shows are those that the evaluation counts, and Meta-World's."""

import os
import re
import subprocess
import sys
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from imageio_ffmpeg import get_ffmpeg_exe
from PIL import Image
from policy_fixtures import save_run

from cmrl_jax.algorithms.cmrl.agent import PolicyParams
from cmrl_jax.analysis.film import HEIGHT, STRIP, WIDTH, Episode
from cmrl_jax.analysis.film_options import FilmOptions
from cmrl_jax.analysis.render import FilmedEnv, film_run
from cmrl_jax.config.files import load_config, to_yaml
from cmrl_jax.evaluation.evaluator import Evaluator
from cmrl_jax.evaluation.session import Policy, Session
from cmrl_jax.jax_runtime import jit_once
from cmrl_jax.storage.checkpoint import policy_store
from cmrl_jax.storage.versions import package_versions
from envs.goal_sets import load_goal_set
from envs.parity.reference import record_rollout
from envs.tasks import METAWORLD_TASKS as TASKS

ROOT = Path(__file__).parents[2]
STEPS = 100  # the scripted policies have succeeded by then


@pytest.fixture(scope="module")
def session():
    return Session(load_config("smoke.yaml", {"env.physics": "native"}))


@pytest.fixture(scope="module")
def params(session):
    learner = session.algorithm.parts
    state = jit_once(learner.init)(jax.random.key(3))
    task_z = np.zeros((learner.num_tasks, learner.inference.latent_dim), np.float32)
    return PolicyParams(state.actor_params, state.encoder_params, state.obs_stats, task_z)


def test_filmed_states_are_metaworlds():
    """Recorded actions of Meta-World through the filmed environment: its states, its successes."""
    goals = load_goal_set("train", TASKS)[:, 4]
    rollouts = [
        record_rollout(task, goal, steps=STEPS) for task, goal in zip(TASKS, goals, strict=True)
    ]
    env = FilmedEnv()

    @jax.jit
    def play(actions):
        state = jax.vmap(env.reset_to)(jnp.arange(len(TASKS)), jnp.asarray(goals, jnp.float32))
        return jax.lax.scan(lambda s, a: (jax.vmap(env.step)(s, a), None), state, actions)[0]

    actions = np.stack([rollout.action for rollout in rollouts], 1)
    play(actions).reward.block_until_ready()
    play(np.zeros_like(actions)).reward.block_until_ready()
    for rollout in rollouts:
        (qpos, success), (idle, idle_success) = env.episodes(rollout.task, rollout.rand_vec)
        np.testing.assert_allclose(qpos, rollout.qpos, atol=1e-6)
        np.testing.assert_array_equal(success[1:], rollout.success)
        assert success.any() and not idle_success.any()
        assert idle.shape == qpos.shape and np.abs(idle - qpos).max() > 0.1
        np.testing.assert_array_equal(idle[0], qpos[0])


def test_a_film_is_the_evaluation_itself(session, params):
    """The returns of the evaluator on an environment that keeps nothing."""
    vectors = dict(zip(session.eval_tasks, session.goals.vectors[:, 0], strict=True))
    options = FilmOptions(k=1, goal=1, seed=5, horizon=20)
    films = film_run(session, Policy(params, vectors, {}), options, "a policy")
    evaluator = Evaluator(session.config, session.env, session.agent, lanes=8, horizon=20)
    scores = evaluator.run([params], session.trial("heldout", 2), (0, 1), seed=5)
    assert [film.task for film in films] == list(session.eval_tasks)
    for row, film in enumerate(films):
        assert [e.name for e in film.episodes] == ["exploration 1 of 1", "reported, k = 1"]
        assert ("held out" in film.caption) == (film.task in session.config.tasks.test)
        for k, episode in enumerate(film.episodes):
            # Another number of lanes: sums in another order.
            np.testing.assert_allclose(episode.returns, scores[k].returns[0, row, 1, 0], rtol=1e-4)
            assert episode.qpos.shape == (21, 10)
    first, second = films[0].episodes
    assert not np.array_equal(first.qpos, second.qpos)  # another z
    assert first.acted_on.startswith("z ") and first.acted_on != second.acted_on


def test_a_filmed_search_says_what_it_tries(session, params):
    vectors = dict(zip(session.eval_tasks, session.goals.vectors[:, 0], strict=True))
    options = FilmOptions(k=4, adapt="search", tasks=("window-close",), horizon=10)
    [film] = film_run(session, Policy(params, vectors, {}), options, "a policy")
    *tried, reported = film.episodes
    names = ["own z", *(f"own z, view {view} of 7" for view in (1, 2, 3))]
    assert [e.acted_on for e in tried] == names
    [chosen] = [e for e in tried if e.acted_on == reported.acted_on]
    assert reported.name == "reported, k = 4"
    np.testing.assert_allclose(reported.returns, chosen.returns, rtol=1e-5)  # played once more


def test_an_evaluation_needs_no_gl(session, tmp_path):
    run = save_run(tmp_path / "run", session, seeds=(1,))
    words = ["eval", "--run", str(run), "--k", "0", "--goals", "1", "--horizon", "10"]
    done = subprocess.run(
        [sys.executable, str(ROOT / "train.py"), *words],
        env=os.environ | {"MUJOCO_GL": "no-such-library"},
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0 and "window-close" in done.stdout, done.stderr


def test_verdict_names_the_first_success():
    success = np.array([False, False, True, True])
    episode = Episode("reported", np.zeros((4, 10)), success, 12.4)
    assert episode.verdict(1) == "no success yet"
    assert episode.verdict(2) == episode.verdict(3) == "success at step 2"
    assert episode.outcome == "success at step 2, return 12"
    never = Episode("reported", np.zeros((4, 10)), np.zeros(4, bool), 1.0)
    assert never.outcome == "no success, return 1"


def test_missing_package_is_named(tmp_path, refused, monkeypatch):
    import importlib.util

    (tmp_path / "config.yaml").write_text(to_yaml(load_config("smoke.yaml")))
    found = importlib.util.find_spec
    missing = lambda name, *rest: None if name == "imageio_ffmpeg" else found(name, *rest)
    monkeypatch.setattr(importlib.util, "find_spec", missing)
    cause, cure = refused("render", "--run", str(tmp_path))
    assert "imageio-ffmpeg" in cause and "cmrl-jax[viz]" in cure
    assert not (tmp_path / "render").exists()


def test_missing_gl_is_said_before_any_compile(tmp_path, refused, monkeypatch):
    (tmp_path / "config.yaml").write_text(to_yaml(load_config("smoke.yaml")))
    monkeypatch.setenv("MUJOCO_GL", "off")
    cause, cure = refused("render", "--run", str(tmp_path))
    assert "MUJOCO_GL=off does not work" in cause and "libegl1 libosmesa6" in cure


def test_a_policy_without_latent_explores_nothing(tmp_path, refused):
    (tmp_path / "config.yaml").write_text(to_yaml(load_config("mtsac.yaml")))
    cause, cure = refused("render", "--run", str(tmp_path), "--k", "2")
    assert "--k 2" in cause and "--k 0" in cure


FILM = """
import sys
import numpy as np
from cmrl_jax.evaluation.evaluator import Evaluator
from cmrl_jax.analysis.film import Camera, Episode, Film, write_sheet, write_video
from envs.goal_sets import load_goal_set
from envs.parity.reference import record_rollout
from pathlib import Path
out, goal = Path(sys.argv[1]), load_goal_set("heldout", ("window-open",))[0, 0]
episodes = []
for policy in ("random", "scripted"):
    r = record_rollout("window-open", goal, policy, steps=100)
    episodes.append(Episode(policy, r.qpos, np.append(False, r.success), r.reward.sum()))
film = Film("window-open", "two policies", goal, tuple(episodes))
with Camera(film) as camera:
    write_video(film, camera, 10, out / "film.mp4")
    write_sheet(film, camera, out / "film.png")
    np.save(out / "taken.npy", np.stack([camera.take(episodes[1], s) for s in (0, 100)]))
"""


def frames(path):
    """All frames of a video (frame, height, width, 3), and its frames a second."""
    command = [get_ffmpeg_exe(), "-i", str(path), "-f", "rawvideo", "-pix_fmt", "rgb24", "-"]
    done = subprocess.run(command, capture_output=True, check=True)
    rate = re.findall(r"([\d.]+) fps", done.stderr.decode())[0]  # of the input, named first
    shape = (-1, HEIGHT + STRIP, WIDTH, 3)
    return np.frombuffer(done.stdout, np.uint8).reshape(shape).astype(float), float(rate)


def test_video_and_sheet_show_the_episodes(gl, tmp_path, monkeypatch):
    monkeypatch.setenv("MUJOCO_GL", gl)
    done = subprocess.run(
        [sys.executable, "-c", FILM, str(tmp_path)], cwd=ROOT, capture_output=True, text=True
    )
    assert done.returncode == 0, done.stderr
    video, rate = frames(tmp_path / "film.mp4")
    assert len(video) == 22 and rate == 8.0  # two episodes of steps 0, 10, .., 100, at real speed
    taken = np.load(tmp_path / "taken.npy").astype(float)
    for frame, picture in zip(video[[11, 21]], taken, strict=True):
        assert np.abs(frame[:HEIGHT] - picture).mean() < 4  # what compression changes
    assert np.abs(taken[0] - taken[1]).mean() > 8
    # Below the picture, black text on white; green once the scripted policy has succeeded.
    green = lambda frame: ((frame[HEIGHT:, :, 1] - frame[HEIGHT:, :, 0]) > 60).sum()
    assert green(video[10]) == 0 < green(video[21])
    sheet = np.asarray(Image.open(tmp_path / "film.png").convert("RGB")).astype(int)
    assert sheet.shape == (32 + 2 * (234 + 32), 6 * 320, 3)
    for name in ("film.mp4", "film.png"):
        assert (tmp_path / name).stat().st_size < 1_000_000


@pytest.mark.slow
def test_render_films_a_policy_checkpoint(gl, session, params, tmp_path):
    config = load_config("smoke.yaml")
    (tmp_path / "config.yaml").write_text(to_yaml(config))
    policy = {"params": params, "goal_vectors": session.goals.vectors[:, 0]}
    meta = {
        "config": {},
        "iteration": 3,
        "env_steps": 1800,
        "wall_s": 1.0,
        "csv_offset": 0,
        "versions": package_versions(),
        "goals_sha256": "",
    }
    with policy_store(tmp_path) as store:
        store.save({"policy": policy}, meta)
    words = ["render", "--run", str(tmp_path), "--horizon", "20", "--every", "10"]
    done = subprocess.run(
        [sys.executable, str(ROOT / "train.py"), *words],
        env=os.environ | {"DISPLAY": ":4242"},  # that of a session which is over
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stderr
    for task in session.eval_tasks:
        assert f"{task}: no success, return" in done.stdout
        video, rate = frames(tmp_path / "render" / f"{task}.mp4")
        assert len(video) == 6 and rate == 8.0
        assert (tmp_path / "render" / f"{task}.png").stat().st_size < 1_000_000

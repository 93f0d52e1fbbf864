"""The public API, used as a program would use it."""

import json
import signal
import threading

import pytest
from run_helpers import ITERATIONS

import cmrl_jax as cj

OVERRIDES = {
    "train.env_steps": 600 * ITERATIONS,
    "env.physics": "native",
    "model.net": "mlp",
}  # the flags of `run_helpers.native`


def in_thread(function):
    """Calls a function off the main thread; returns what it returns, raises what it raises."""
    outcome = []

    def target():
        try:
            outcome.append((function(), None))
        except BaseException as error:
            outcome.append((None, error))

    thread = threading.Thread(target=target)
    thread.start()
    thread.join()
    [(result, error)] = outcome
    if error is not None:
        raise error
    return result


@pytest.fixture(scope="module")
def handler():
    """A SIGTERM handler of the program's own."""
    old = signal.getsignal(signal.SIGTERM)
    ours = lambda number, frame: None
    signal.signal(signal.SIGTERM, ours)
    yield ours
    signal.signal(signal.SIGTERM, old)


@pytest.fixture(scope="module")
def results(tmp_path_factory, handler):
    """The snippet of the README, twice, in a thread that is not the main one."""

    def snippet(run_dir):
        config = cj.load_config("smoke", OVERRIDES, seed=0)
        result = cj.train(config, run_dir=run_dir)
        return result, cj.evaluate(result.agent, tasks=["window-close"], k=(0, 1), goals=2)

    made = tmp_path_factory.mktemp("api")
    return [in_thread(lambda n=n: snippet(made / n)) for n in ("first", "second")]


def test_it_trains_off_the_main_thread_as_the_command_does(results, handler, undisturbed):
    assert signal.getsignal(signal.SIGTERM) is handler
    for result, _ in results:
        assert result.is_finished and result.iteration == ITERATIONS
        found = json.loads((result.run_dir / "eval.json").read_text())
        assert result.evaluation == found["tasks"]
        text = (undisturbed / "eval.json").read_text()
        assert (result.run_dir / "eval.json").read_text() == text
        assert [row["iteration"] for row in result.metrics] == list(range(ITERATIONS))
        assert (result.run_dir / "config.yaml").read_bytes() == (
            undisturbed / "config.yaml"
        ).read_bytes()


def test_an_evaluation_is_a_table_rows_and_json(results, tmp_path):
    (_, first), (_, second) = results
    assert first.tasks == second.tasks
    assert "window-close" in first.table() and len(first.table().splitlines()) == 3
    rows = first.rows()
    assert [(row["task"], row["k"]) for row in rows] == [("window-close", 0), ("window-close", 1)]
    for row in rows:
        assert row["success_any_low"] <= row["success_any"] <= row["success_any_high"]
        assert row["return"] == first.tasks["window-close"][str(row["k"])]["return"]
    first.to_json(tmp_path / "new" / "e.json")
    saved = json.loads((tmp_path / "new" / "e.json").read_text())
    assert saved["tasks"] == first.tasks and saved["goals"] == 2


def test_a_stop_from_another_thread_ends_a_run_that_goes_on(tmp_path, results, capsys):
    """A logger asks for it after the first row."""

    class Once(cj.Logger):
        def row(self, row, progress):
            stop.request()

    stop = cj.Stop()
    config = cj.load_config("smoke", OVERRIDES)
    stopped = cj.train(config, tmp_path / "run", loggers=[Once()], stop=stop)
    assert (stopped.iteration, stopped.is_finished, stopped.evaluation) == (1, False, None)
    assert stopped.agent.iteration == 1
    resumed = cj.train(config, tmp_path / "run", resume=True, loggers=[])
    assert resumed.is_finished and resumed.evaluation == results[0][0].evaluation
    assert capsys.readouterr().out == ""


@pytest.mark.parametrize(
    ("overrides", "cause", "cure"),
    [
        ({"sac.bach": 64}, "unknown key 'sac.bach'", "sac.batch"),
        ({"sac": 64}, "'sac' is a section", "sac.variant"),
        ({"sac": {"lr": 1}}, "'sac' is a section", "sac.variant"),
        ({"nosuch.batch": 64}, "unknown key 'nosuch.batch'", "valid"),
        ({"sac.batch": 64.5}, "sac.batch needs a whole number, got 64.5", "whole number"),
        ({"sac.batch": True}, "sac.batch needs a whole number", "whole number"),
        ({"tasks.train": ["drawer-opn"]}, "drawer-opn", "drawer-open"),
        ({"seed": -1}, "seed", ""),
    ],
)
def test_overrides_are_typed_and_checked(overrides, cause, cure):
    with pytest.raises(cj.ConfigError) as raised:
        cj.load_config("smoke", overrides)
    assert cause in raised.value.cause and cure in raised.value.cure


def test_overrides_may_be_text_as_on_the_command_line():
    tasks = ("drawer-open", "window-open", "window-close")
    typed = {"sac.batch": 64, "tasks.train": tasks, "tasks.test": (), "log.progress": False}
    text = {"sac.batch": "64", "tasks.train": ",".join(tasks), "tasks.test": ""}
    text["log.progress"] = "false"
    assert cj.load_config("pearl", typed) == cj.load_config("pearl.yaml", text)
    assert cj.load_config("ml4", seed=7).seed == 7


@pytest.mark.parametrize(
    ("options", "cause"),
    [
        ({"tasks": ["door-open"]}, "unknown task 'door-open'"),
        ({"k": ()}, "--k"),
        ({"k": (-1,)}, "k is"),
        ({"goals": 51}, "goals is 51"),
        ({"draws": 0}, "draws is 0"),
        ({"physics": "mujoco"}, "physics is 'mujoco'"),
        ({"physics": "metaworld"}, "command line"),
        ({"gaols": 2}, "unknown option 'gaols'"),
    ],
)
def test_options_of_an_evaluation_are_checked(results, options, cause):
    with pytest.raises(cj.ConfigError) as raised:
        cj.evaluate(results[0][0].agent, **options)
    assert cause in raised.value.cause and raised.value.cure


def test_a_run_that_is_not_there_is_one_cause_and_one_cure(tmp_path, results):
    with pytest.raises(cj.ConfigError, match="does not exist"):
        cj.load_agent(tmp_path / "nope")
    with pytest.raises(cj.ConfigError, match="already holds a run"):
        cj.train(cj.load_config("smoke"), results[0][0].run_dir)


def test_an_environment_is_pure_functions_of_one_lane():
    import jax
    import jax.numpy as jnp

    env = cj.make_env(physics="native")
    state = env.reset(jax.random.key(0), jnp.int32(2))
    assert env.step(state, jnp.zeros(4)).obs.shape == state.obs.shape == (39,)
    with pytest.raises(cj.ConfigError, match="observation mode .nosuch"):
        cj.make_env(obs_mode="nosuch")


def test_the_package_says_what_it_offers():
    assert set(cj.__all__) <= set(dir(cj))
    for name in cj.__all__:
        assert getattr(cj, name).__doc__
    with pytest.raises(AttributeError, match="nosuch"):
        _ = cj.nosuch

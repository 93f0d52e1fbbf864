"""Small runs as `plot` reads them, written by hand: two tasks' figures, no checkpoint."""

import json

from cmrl_jax.config.files import load_config, to_yaml

CSV = """iteration,env_steps,train/window-open/success_any,eval/window-open/k0/success_any
0,100,0.0,
1,200,0.5,0.25
2,300,1.0,
"""


def evaluation(by_k, task="window-open", **facts):
    """The document of an eval.json: `by_k` is k -> success at any step, in the order given."""
    figures = lambda success: {"success_any": success, "success_last": success / 2, "return": 9.0}
    tasks = {task: {str(k): figures(success) for k, success in by_k.items()}}
    return {"tasks": tasks, "goals": 2, "goal_set": "heldout", "iteration": 3, "seed": 0} | facts


def write_run(run, csv=CSV, by_k=None, flags=None, **facts):
    """A run of smoke.yaml under dotted `flags`; with `by_k` its final evaluation too."""
    run.mkdir(parents=True)
    (run / "metrics.csv").write_text(csv)
    (run / "config.yaml").write_text(to_yaml(load_config("smoke.yaml", flags)))
    if by_k is not None:
        (run / "eval.json").write_text(json.dumps(evaluation(by_k, **facts)))
    return run

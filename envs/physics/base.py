"""What a physics backend offers the environment, and the settled states that episodes start from.

Observation, reward and success are written once, in `sawyer.py`, over `Positions`; `mjx` computes
the physics on the device, `native` runs MuJoCo C on the host.
"""

from __future__ import annotations

import functools
from typing import Any, NamedTuple, Protocol

import jax
import numpy as np
from flax import struct

from envs.engine import mujoco
from envs.physics.model import FRAME_SKIP, SLIDE, Fixture, load_scene
from envs.tasks.base import Task
from envs.tasks.specs import SPECS

SETTLE_STEPS = 50  # SawyerXYZEnv._reset_hand
MOCAP_QUAT = (1.0, 0.0, 1.0, 0.0)  # SawyerMocapBase: the hand points down; MuJoCo normalises it


class Positions(struct.PyTreeNode):
    """What observation and reward read from a physics state, metres in the world."""

    hand: jax.Array  # (3,) body `hand`
    right_tip: jax.Array  # (3,) site rightEndEffector
    left_tip: jax.Array  # (3,)
    finger_gap: jax.Array  # () distance of the claw bodies
    fixture: jax.Array  # (3,) the fixture's moving body
    slide: jax.Array  # () fixture slide position


class Physics(Protocol):
    """A backend. All methods are pure jittable functions of one lane; callers vmap them.

    A lane's physics state is the backend's own pytree. Its attribute `placement` (3,) is the
    fixture's position in metres.
    """

    @property
    def timestep(self) -> float:
        """Seconds of a substep; a control step has `FRAME_SKIP` of them."""
        ...

    def start(self, task_id: jax.Array, placement: jax.Array) -> Any:
        """The settled physics state of a task with the fixture at `placement` (3,)."""
        ...

    def advance(self, state: Any, action: jax.Array, scene_id: jax.Array) -> tuple[Any, jax.Array]:
        """One control step: moves the mocap target, then simulates.

        Args:
            action: (4,) in [-1, 1], hand displacement / 0.01 m and finger effort.
            scene_id: index into `model.SCENES`.

        Returns:
            The new state, and () bool: whether it is finite. If not, it must not be used.
        """
        ...

    def positions(self, state: Any, scene_id: jax.Array) -> Positions:
        """Positions as Meta-World reads them, after a forward pass on the state."""
        ...

    def fixture(self, scene_id: jax.Array) -> Fixture:
        """The fixture's numbers, leaves float32."""
        ...


class Start(NamedTuple):
    """The start of every episode of a task, float64; with a leading task axis when stacked."""

    qpos: np.ndarray  # (10,) 7 arm hinges, right finger, left finger, fixture slide
    qvel: np.ndarray  # (10,)
    warm_start: np.ndarray  # (10,) last joint acceleration
    mocap: np.ndarray  # (3,) commanded hand position, metres
    hand: np.ndarray  # (3,) hand position as observed after a reset
    opening: np.ndarray  # () gripper opening as observed after a reset
    init_tcp: np.ndarray  # (3,) finger-tip midpoint that the reward refers to


def settle(spec: Task) -> Start:
    """The start of a task, by MuJoCo C.

    Meta-World pulls the hand from the zero pose to its start for 50 x 5 substeps at every reset;
    the outcome does not depend on the goal, so it is computed once. What Meta-World then shows and
    remembers is one substep behind the state, unless the task runs a forward pass (drawer-close).
    """
    model = load_scene(spec.scene)
    data = mujoco.MjData(model)
    for _ in range(SETTLE_STEPS):
        data.mocap_pos[0] = spec.hand_start
        data.mocap_quat[0] = MOCAP_QUAT
        data.ctrl[:] = [-1, 1]
        mujoco.mj_step(model, data, nstep=FRAME_SKIP)
    tips = [data.site(name).xpos for name in ("rightEndEffector", "leftEndEffector")]
    init_tcp = np.mean(tips, 0)
    qpos, qvel, warm_start = data.qpos.copy(), data.qvel.copy(), data.qacc_warmstart.copy()
    if spec.forward_at_reset:
        mujoco.mj_forward(model, data)
    gap = np.linalg.norm(data.body("rightclaw").xpos - data.body("leftclaw").xpos)
    qpos[SLIDE] = spec.start_slide
    return Start(
        qpos=qpos,
        qvel=qvel,
        warm_start=warm_start,
        mocap=np.array(spec.hand_start, np.float64),
        hand=data.body("hand").xpos.copy(),
        opening=np.clip(gap / 0.1, 0.0, 1.0),
        init_tcp=init_tcp,
    )


@functools.cache
def settled_starts() -> Start:
    """The starts of all tasks, stacked in the order of `tasks.TASKS`; computed once a process."""
    starts = Start(*(np.stack(leaves) for leaves in zip(*map(settle, SPECS), strict=True)))
    for leaf in starts:
        leaf.flags.writeable = False
    return starts

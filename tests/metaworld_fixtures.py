"""What tests of evaluations in Meta-World's own environments share."""

import numpy as np


class Recorder:
    """Environments that keep what truly happened: the last observation is not the reset's."""

    def __init__(self, envs):
        self.envs, self.num_envs, self.episodes = envs, envs.num_envs, [[]]

    def reset(self):
        self.obs, info = self.envs.reset()
        return self.obs, info

    def step(self, action):
        next_obs, reward, terminated, truncated, info = self.envs.step(action)
        over = truncated.any() or terminated.any()
        true_next = np.stack(info["final_obs"]) if over else next_obs
        self.episodes[-1].append((self.obs, action, reward.copy(), true_next))
        self.obs = next_obs
        if over:
            self.episodes.append([])
        return next_obs, reward, terminated, truncated, info

    def __getattr__(self, name):
        return getattr(self.envs, name)

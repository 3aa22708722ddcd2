"""MADDPG-LSTMactor: MADDPG whose actors see a window of observations (paper, section III.A)."""

from __future__ import annotations

from rllib_maobs.algorithms.maddpg import MADDPG, MADDPGConfig


class MADDPGLSTMConfig(MADDPGConfig):
    """Configuration of MADDPG-LSTMactor: MADDPG with `actor="lstm"`.

    ```python
    config = MADDPGLSTMConfig().environment("maobs/spread-3a").training(seq_length=5)
    algo = config.build_algo()
    algo.train()
    ```

    Eq. 10: u_a = mu_a({o_a^(t-i)}, i = 0..T-1), an LSTM over the last `seq_length` observations (`LSTMActor`) that
    starts every window from zero h and c, when it acts and when it learns alike. Windows never cross a reset,
    and one at an episode's start is as long as the episode so far. Critics and both losses are MADDPG's (eq. 2
    and 3); the target actors' windows end one step later. Any algorithm here takes `actor="lstm"`. The paper does not
    give the LSTM's size: it is `lstm_cell_size`, 64 units unless `rl_module(model_config={...})` says otherwise.

    With `stored_state=True` it is eq. 10 to the letter, u_a = mu_a({o_a^(t-i)}, h^(t-1), c^(t-1)): the window at step t
    starts from the h and c with which the one at t-1 ended, which learning takes from replay as acting had them. They
    have seen all but the newest of its observations before; with `seq_length=1` each is seen once.
    """

    name = "maddpg-lstm"

    def __init__(self, algo_class: type | None = None) -> None:
        super().__init__(algo_class=algo_class)
        self.actor = "lstm"


class MADDPGLSTM(MADDPG):
    """MADDPG-LSTMactor, see `MADDPGLSTMConfig`."""

    config_class = MADDPGLSTMConfig

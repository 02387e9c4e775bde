"""``armsight demo``: the experiment of ``armsight run`` in the simulated workcell, with the truth beside it."""

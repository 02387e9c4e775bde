"""What a rig that is not built yet will measure: a plan and the catalogue go in, a :class:`~.result.RigBudget` comes out.

``plan`` is what is wished and what there is; ``chart`` the noise of markers, from rendered charts; ``result`` the budget of
a plan, its causes, and what would change it; ``best`` the plan that measures best within bounds.
"""

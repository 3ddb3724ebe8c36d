"""`--policy.type=relmm_single`: the paper's ablation, one soft actor-critic over navigation and grasping at once."""

"""`--policy.type=relmm_random`: the paper's "Rand all" baseline."""

"""`--policy.type=relmm`: the hierarchical policy of ReLMM, a grasp ensemble and a navigation policy."""

"""`--policy.type=relmm_paper`: ReLMM as its paper has it, a dense grasp ensemble and soft actor-critic on pictures."""

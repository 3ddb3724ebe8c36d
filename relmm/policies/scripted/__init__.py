"""`--policy.type=relmm_scripted`: the paper's OpenCV controller."""

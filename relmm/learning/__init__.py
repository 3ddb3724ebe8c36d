"""The loop around a robot and a policy: acting, pseudo-resets, recording."""

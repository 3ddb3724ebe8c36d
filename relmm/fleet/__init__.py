"""Robots on other machines: sealed episodes come in, weights go out, over gRPC with TLS and a token.

The dataset is the transport: a robot records where it is, and what it has saved is sent once, in order. The server
keeps a mirror of each robot's dataset, which `relmm-train --dataset.follow` learns from. Nothing is ever unpickled.
"""

"""relmm-record, relmm-eval and relmm-doctor: parse, wire together, nothing else."""

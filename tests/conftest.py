"""Nothing here may reach the network, or the caches of whoever runs the tests."""

import os
import tempfile

# Before the first import of huggingface_hub, which reads them once.
os.environ["HF_HUB_OFFLINE"] = "1"
os.environ["HF_HOME"] = tempfile.mkdtemp(prefix="relmm-test-hf-")
os.environ.pop("HF_LEROBOT_HOME", None)

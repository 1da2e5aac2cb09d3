"""The loop on a real network: peers as processes, their packets, and what happened beside what was said."""

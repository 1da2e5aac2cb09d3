"""Real-time execution over a real network: peers as processes, their packets, comparison with analysis."""

"""Text to CasADi: one file a stage, each importing only what comes before it. Never imports apc.runtime."""

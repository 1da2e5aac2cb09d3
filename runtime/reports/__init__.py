"""Everything that is known of topologies, gathered for a page that is kept and computed again."""

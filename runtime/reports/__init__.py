"""Everything that is known of scenes, gathered for a page that is kept and computed again."""

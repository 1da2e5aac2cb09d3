"""A topology section by section: groups, parts, couplings, links."""

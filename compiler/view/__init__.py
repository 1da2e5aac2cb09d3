"""What a person or an editor is shown of a scene: listing, diagram, picture, schema."""

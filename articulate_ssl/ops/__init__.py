"""Fast group-equivariant operators; `ops.reference` holds their readable twins."""

"""One YAML file per category; `render.category.CategorySpec` documents the fields."""

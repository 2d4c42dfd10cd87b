"""The HTML report on an area: verdict, key figures, 3D view, tables."""

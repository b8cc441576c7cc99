"""A shot in a browser: the scene as bytes (`scene.py`), the page that draws it (`page/`), and the html exporter."""

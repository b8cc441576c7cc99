"""The one gate for foreign files: meshes, images, arrays, USD and TOML.

What comes in is bounded in size and checked before anything else sees it: plain arrays that are finite, with indices in
range; plain tables without numbers that overflow. Whatever a library raises over a broken file becomes an
``InputError`` that names file, key and remedy. What belongs here knows formats, and nothing of what files are used for.
"""

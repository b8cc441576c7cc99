"""The only entrance for foreign files: meshes, images, arrays, USD and TOML.

Input is bounded in size and checked before other code sees it: finite plain arrays with indices in range, plain tables
without numbers that overflow. Any error of a library over a broken file becomes an ``InputError`` that names file, key
and fix. This room knows formats, not the use of the files.
"""

"""Files that hold G-code in something else: binary G-code and sliced 3MF packages."""

"""highway-env's roads and traffic in this project's words.

Whoever imports a module of this package needs highway-env; nothing else of the project does.
"""

"""The only definitions of errors and driving scores: pure functions of arrays.

Each gives values and a mask of where they mean something; averaging happens elsewhere, once.
"""

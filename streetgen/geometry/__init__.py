"""What stands in the street: meshes, what they are made of, and where things go.

``layout`` says where, the other modules say what. All of it is numpy; no renderer is known here.
"""

"""Model the things that stand in the street as meshes with materials.

``layout`` plans where things stand, the other modules make them. All of it is numpy; no renderer is
known here.
"""

"""How far a surface moved between two epochs: distances along normals with their significance, volumes, displacements.

Arrays in, arrays out, of one piece of ground; `work` reads, calls and writes. Epoch B lies in the frame of A already.
"""

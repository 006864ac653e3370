"""Bundle block adjustment: image points, poses, control and lidar surfaces in one least squares, points eliminated (Schur).

`block` says what there is, `unknowns` which columns it has, `rows` what one image point says, `schur` sums and eliminates, `solve` steps,
`covariance` and `report` say what came of it. Source of the method: Triggs et al., Bundle adjustment - a modern synthesis
(2000), sections 4 to 6; of the photogrammetric terms: Kraus, Photogrammetry (2nd ed. 2007), chapter 5.
"""

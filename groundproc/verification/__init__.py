"""Whether a lidar measures as its data sheet says: reference panels of known reflectance, seen from a tripod.

Source: FOI-R--4045--SE (2014), appendix B: panels of 1 m2 at 5 to 60 m, the scatter of ranges and the intensity against the distance, and
the distance from which on a dark panel is not seen any more.

panels.yaml --panels--> Panels;  log --aimed--> shots at each panel, those without an echo too --measure--> figures --judge--> verdict
"""

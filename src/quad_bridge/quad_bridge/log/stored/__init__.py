"""Intact content of a bag's storage files, damaged or not.

quad_bridge and quad_sysid share this folder by a link, because the analysis is installed without
quad_bridge; it imports nothing of either.
"""

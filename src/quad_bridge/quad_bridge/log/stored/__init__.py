"""What lies in a bag's storage files, damaged or not.

quad_bridge and quad_sysid share this one folder by a link, because the analysis is installed
without quad_bridge: nothing of either is imported here.
"""

"""How an LED looks from a ray: dome, collar and brightness as a surface of revolution."""

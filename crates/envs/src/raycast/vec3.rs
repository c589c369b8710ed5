//! Vectors and rotations in space, single precision as in MuJoCo's abstract scene.

use std::ops::{Add, Mul, Neg, Sub};

/// A point, a direction or a size.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct Vec3 {
    /// First component.
    pub x: f32,
    /// Second component.
    pub y: f32,
    /// Third component.
    pub z: f32,
}

impl Vec3 {
    /// The vector of these components.
    pub const fn new(x: f32, y: f32, z: f32) -> Self {
        Self { x, y, z }
    }

    pub(crate) fn dot(self, other: Self) -> f32 {
        self.x * other.x + self.y * other.y + self.z * other.z
    }

    pub(crate) fn cross(self, other: Self) -> Self {
        Self::new(
            self.y * other.z - self.z * other.y,
            self.z * other.x - self.x * other.z,
            self.x * other.y - self.y * other.x,
        )
    }

    /// Component by component.
    pub(crate) fn scale(self, other: Self) -> Self {
        Self::new(self.x * other.x, self.y * other.y, self.z * other.z)
    }

    pub(crate) fn abs(self) -> Self {
        Self::new(self.x.abs(), self.y.abs(), self.z.abs())
    }

    pub(crate) fn norm(self) -> f32 {
        self.dot(self).sqrt()
    }

    /// Of length one; zero stays zero.
    pub(crate) fn unit(self) -> Self {
        let norm = self.norm();
        if norm > 0.0 {
            self * (1.0 / norm)
        } else {
            self
        }
    }
}

impl From<[f32; 3]> for Vec3 {
    fn from([x, y, z]: [f32; 3]) -> Self {
        Self { x, y, z }
    }
}

impl Add for Vec3 {
    type Output = Self;
    fn add(self, other: Self) -> Self {
        Self::new(self.x + other.x, self.y + other.y, self.z + other.z)
    }
}

impl Sub for Vec3 {
    type Output = Self;
    fn sub(self, other: Self) -> Self {
        Self::new(self.x - other.x, self.y - other.y, self.z - other.z)
    }
}

impl Neg for Vec3 {
    type Output = Self;
    fn neg(self) -> Self {
        Self::new(-self.x, -self.y, -self.z)
    }
}

impl Mul<f32> for Vec3 {
    type Output = Self;
    fn mul(self, factor: f32) -> Self {
        Self::new(self.x * factor, self.y * factor, self.z * factor)
    }
}

/// Where a geom is and how it is turned.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Frame {
    /// Its centre.
    pub position: Vec3,
    /// Directions of its own x, y and z axes, orthonormal.
    pub axes: [Vec3; 3],
}

impl Frame {
    /// Unturned at `position`.
    pub const fn at(position: Vec3) -> Self {
        let axes = [
            Vec3::new(1.0, 0.0, 0.0),
            Vec3::new(0.0, 1.0, 0.0),
            Vec3::new(0.0, 0.0, 1.0),
        ];
        Self { position, axes }
    }

    /// A direction of the world, seen from the frame.
    pub(crate) fn to_local(self, direction: Vec3) -> Vec3 {
        let [x, y, z] = self.axes;
        Vec3::new(direction.dot(x), direction.dot(y), direction.dot(z))
    }

    /// A direction of the frame, seen from the world.
    pub(crate) fn to_world(self, direction: Vec3) -> Vec3 {
        let [x, y, z] = self.axes;
        x * direction.x + y * direction.y + z * direction.z
    }
}

//! Triangle meshes.

use super::vec3::Vec3;

/// Triangles with normals at their corners.
#[derive(Debug, Clone)]
pub struct Mesh {
    triangles: Vec<Triangle>,
    /// The smallest box around them, by its centre and half sizes.
    centre: Vec3,
    half: Vec3,
}

/// One triangle, its corners counter-clockwise seen from outside.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Triangle {
    /// The corners.
    pub corners: [Vec3; 3],
    /// Normals at the corners, unit vectors.
    pub normals: [Vec3; 3],
    /// Texture coordinates of the corners.
    pub texture: Option<[[f32; 2]; 3]>,
}

/// Where a ray enters a mesh.
#[derive(Debug, Clone, Copy)]
pub(crate) struct MeshHit {
    pub(crate) distance: f32,
    pub(crate) triangle: usize,
    /// Weights of the triangle's second and third corner.
    pub(crate) weights: [f32; 2],
}

impl Mesh {
    /// The mesh of these triangles.
    pub fn new(triangles: Vec<Triangle>) -> Self {
        let mut low = Vec3::new(f32::MAX, f32::MAX, f32::MAX);
        let mut high = -low;
        for corner in triangles.iter().flat_map(|triangle| triangle.corners) {
            low = Vec3::new(
                low.x.min(corner.x),
                low.y.min(corner.y),
                low.z.min(corner.z),
            );
            high = Vec3::new(
                high.x.max(corner.x),
                high.y.max(corner.y),
                high.z.max(corner.z),
            );
        }
        if triangles.is_empty() {
            (low, high) = (Vec3::default(), Vec3::default());
        }
        Self {
            triangles,
            centre: (low + high) * 0.5,
            half: (high - low) * 0.5,
        }
    }

    /// Centre and half sizes of the smallest box around it.
    pub(crate) fn bounds(&self) -> (Vec3, Vec3) {
        (self.centre, self.half)
    }

    /// The first triangle that faces `origin` and is hit in `direction` farther than `nearest`, in multiples of
    /// `direction`.
    pub(crate) fn hit(&self, origin: Vec3, direction: Vec3, nearest: f32) -> Option<MeshHit> {
        let mut best: Option<MeshHit> = None;
        for (index, triangle) in self.triangles.iter().enumerate() {
            let Some((distance, weights)) = triangle.hit(origin, direction) else {
                continue;
            };
            if distance > nearest && best.is_none_or(|best| distance < best.distance) {
                best = Some(MeshHit {
                    distance,
                    triangle: index,
                    weights,
                });
            }
        }
        best
    }

    /// The normal at a hit.
    pub(crate) fn normal(&self, hit: &MeshHit) -> Vec3 {
        let [second, third] = hit.weights;
        let [a, b, c] = self.triangles[hit.triangle].normals;
        (a * (1.0 - second - third) + b * second + c * third).unit()
    }

    /// Texture coordinates where a ray meets the plane of a triangle.
    pub(crate) fn texture(
        &self,
        triangle: usize,
        origin: Vec3,
        direction: Vec3,
    ) -> Option<[f32; 2]> {
        let triangle = &self.triangles[triangle];
        let [a, b, c] = triangle.texture?;
        let [second, third] = triangle.weights(origin, direction);
        let first = 1.0 - second - third;
        Some(std::array::from_fn(|k| {
            a[k] * first + b[k] * second + c[k] * third
        }))
    }
}

impl Triangle {
    /// Sharp at those corners whose normal's cosine to the triangle's own is below `smooth`.
    #[must_use]
    pub fn with_edges(mut self, smooth: f32) -> Self {
        let [a, b, c] = self.corners;
        let flat = (b - a).cross(c - a).unit();
        for normal in &mut self.normals {
            if normal.dot(flat) < smooth {
                *normal = flat;
            }
        }
        self
    }

    /// Distance and weights of the second and third corner where a ray enters the front.
    fn hit(&self, origin: Vec3, direction: Vec3) -> Option<(f32, [f32; 2])> {
        let [a, b, c] = self.corners;
        let (edge1, edge2) = (b - a, c - a);
        let across = direction.cross(edge2);
        let volume = edge1.dot(across);
        if volume <= 0.0 {
            return None;
        }
        let offset = origin - a;
        let second = offset.dot(across);
        if second < 0.0 || second > volume {
            return None;
        }
        let along = offset.cross(edge1);
        let third = direction.dot(along);
        if third < 0.0 || second + third > volume {
            return None;
        }
        let scale = 1.0 / volume;
        Some((edge2.dot(along) * scale, [second * scale, third * scale]))
    }

    /// Weights of the second and third corner where a ray meets the triangle's plane.
    fn weights(&self, origin: Vec3, direction: Vec3) -> [f32; 2] {
        let [a, b, c] = self.corners;
        let (edge1, edge2) = (b - a, c - a);
        let across = direction.cross(edge2);
        let scale = 1.0 / edge1.dot(across);
        let offset = origin - a;
        [
            offset.dot(across) * scale,
            direction.dot(offset.cross(edge1)) * scale,
        ]
    }
}
